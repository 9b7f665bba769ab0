//! Answers telemetry with a command.

use std::sync::PoisonError;
use std::sync::atomic::Ordering;
use std::time::Instant;

use data_encoding::BASE64;

use super::{Connection, End};
use crate::net::connections::Rank;
use crate::serve::co_driver::AnsweredFrame;
use crate::serve::helm::{self, FrameTime};
use crate::serve::journal::Incident;
use crate::serve::recording::{Queued, Recorder};
use crate::serve::seat::Claim;
use crate::simulator::DriverAnswer;
use crate::simulator::car::dynamics::MAX_STEER_DEG;
use crate::udacity::{ClientPacket, Command, DecimalMark, NumberStyle, Telemetry};

/// Largest height or width of a picture, pixels.
const MAX_IMAGE_SIDE: usize = 1920;
/// Smallest throttle that must move a car.
const STRONG_THROTTLE: f32 = 0.2;
/// Number of commands with a strong throttle after which a car must follow.
const MAX_IGNORED: u32 = 40;

impl Connection<'_, '_> {
    /// Answers the newest telemetry, whose last byte arrived at `arrived`.
    pub(super) fn answer(&mut self, packet: ClientPacket, arrived: Instant) -> Result<(), End> {
        let telemetry = match packet {
            ClientPacket::Telemetry(telemetry, _) => telemetry,
            _ => return self.let_person_drive(arrived),
        };
        self.learn_style(&telemetry);
        if telemetry.by_user {
            return self.learn_from_person(&telemetry, arrived);
        }
        if self.overridden {
            self.overridden = false;
            self.shared.journal.step(format_args!("{}: the model drives again", self.address));
        }
        let time = telemetry.time_s.map_or(FrameTime::Arrival(arrived), FrameTime::Simulated);
        let blind = (time, telemetry.speed_mph);
        let Some(image) = &telemetry.image else {
            return self.bad_telemetry(Incident::NoImage, format_args!("telemetry without an image"), blind);
        };
        let Some(speed_mph) = telemetry.speed_mph else {
            return self.bad_telemetry(Incident::NoSpeed, format_args!("telemetry without a speed"), blind);
        };
        let answer = match self.look(image) {
            Ok(answer) => answer,
            Err(text) => return self.bad_telemetry(Incident::UnreadableImage, format_args!("{text}"), blind),
        };
        match self.shared.seat.claim(self.peer.id, &self.peer.stream, Instant::now()) {
            Claim::Kept => {}
            Claim::Taken => {
                self.peer.set_rank(Rank::InUse);
                self.waits = false;
                self.shared.journal.report(Incident::Drives, format_args!("{} is driven", self.address));
            }
            // Another client was faster. The question keeps the token of this one.
            Claim::Refused => return self.ask(),
        }
        self.faults = 0;
        self.lockstep = telemetry.time_s.is_some();
        let hands = self.shared.co_driver.and_then(|co_driver| co_driver.hands(Instant::now()));
        self.tell_who_drives(hands.is_some());
        let command = match hands {
            Some(hands) => self.helm.command_by_hand(hands, answer, speed_mph, time),
            None => self.helm.command_for(answer, speed_mph, time),
        };
        self.steer(command)?;
        self.cut = false;
        self.shared.statistics().answered(arrived, Instant::now(), command, speed_mph);
        self.check_throttle(&telemetry, command);
        if let Some(recorder) = &self.shared.recorder {
            self.record(recorder, (time, command, speed_mph), hands.is_some());
        }
        if let Some(co_driver) = self.shared.co_driver {
            let frame = AnsweredFrame {
                time_s: self.helm.seconds(time),
                image: &self.image,
                steering_of_model: helm::usable(answer.steering),
                steering: command.steering,
                throttle: command.throttle,
                speed_mph,
                by_user: hands.is_some(),
            };
            co_driver.see(&frame, self.shared.recorder.as_ref().map(Recorder::rows_by_user));
        }
        Ok(())
    }

    /// Tells the user when the co-driver takes the wheel, and when the model gets it back.
    fn tell_who_drives(&mut self, by_co_driver: bool) {
        if std::mem::replace(&mut self.co_driven, by_co_driver) == by_co_driver {
            return;
        }
        match by_co_driver {
            true => {
                self.shared.journal.report(Incident::CoDriver, format_args!("{}: driven from the page", self.address))
            }
            false => self.shared.journal.step(format_args!("{}: the model drives again", self.address)),
        }
    }

    /// The answer of the model to a picture in base64.
    fn look(&mut self, image: &str) -> Result<DriverAnswer, String> {
        let len = BASE64.decode_len(image.len()).map_err(|_| "an image whose base64 is incomplete".to_string())?;
        self.image.resize(len, 0);
        let len = BASE64
            .decode_mut(image.as_bytes(), &mut self.image)
            .map_err(|partial| format!("an image that is not base64: {}", partial.error))?;
        self.image.truncate(len);
        let mut pilot = self.shared.pilot.lock().unwrap_or_else(PoisonError::into_inner);
        let answer = pilot
            .answer_encoded_within(&self.image, MAX_IMAGE_SIDE)
            .map_err(|error| format!("an image that cannot be used: {error}"))?;
        Ok(DriverAnswer { steering: answer.steering, pace: pilot.pace(&answer) })
    }

    fn learn_style(&mut self, telemetry: &Telemetry) {
        let style = telemetry.number_style();
        if style == self.style {
            return;
        }
        self.style = style;
        match style {
            NumberStyle::Json => {
                let text = format_args!("{}: a simulator of the second term (it sends `cte`)", self.address);
                self.shared.journal.report(Incident::SecondTerm, text);
            }
            NumberStyle::Strings(mark) if mark != DecimalMark::DOT => {
                let text = format_args!("{}: writes numbers with the decimal mark `{}`", self.address, mark.char());
                self.shared.journal.report(Incident::DecimalMark, text);
            }
            NumberStyle::Strings(_) => {}
        }
    }

    /// A person steers, and the picture goes on: it is recorded with that steering.
    fn learn_from_person(&mut self, telemetry: &Telemetry, arrived: Instant) -> Result<(), End> {
        let held = self.shared.seat.is_held_by(self.peer.id, arrived);
        if let (Some(recorder), Some(image), Some(steering_deg), Some(speed_mph), true) =
            (&self.shared.recorder, &telemetry.image, telemetry.steering_deg, telemetry.speed_mph, held)
        {
            // The model need not answer; but a picture that it could not use is not recorded.
            if let Err(text) = self.look(image) {
                self.fault(Incident::UnreadableImage, format_args!("{text}"))?;
                return self.let_person_drive(arrived);
            }
            let time = telemetry.time_s.map_or(FrameTime::Arrival(arrived), FrameTime::Simulated);
            let steering = (steering_deg / MAX_STEER_DEG).clamp(-1.0, 1.0) as f32;
            let command = Command { steering, throttle: telemetry.throttle.unwrap_or(0.0).clamp(0.0, 1.0) as f32 };
            self.record(recorder, (time, command, speed_mph), true);
        }
        self.let_person_drive(arrived)
    }

    /// Records the frame at hand.
    fn record(&self, recorder: &Recorder, (time, command, speed_mph): (FrameTime, Command, f64), by_user: bool) {
        match recorder.push(time, &self.image, command, speed_mph, by_user) {
            Queued::Yes => {}
            Queued::Dropped => {
                self.shared.journal.report(Incident::RecordingLags, format_args!("a frame could not be recorded"));
            }
            Queued::Failed => self.shared.recording_failed.store(true, Ordering::Relaxed),
        }
    }

    fn let_person_drive(&mut self, arrived: Instant) -> Result<(), End> {
        if !self.overridden {
            self.overridden = true;
            self.shared.journal.report(Incident::Override, format_args!("{}: a person drives", self.address));
        }
        self.shared.seat.is_held_by(self.peer.id, arrived);
        self.helm.release();
        (self.ignored, self.cut) = (0, false);
        self.ask()
    }

    /// Reports telemetry that cannot be used, and answers it with its time and speed.
    fn bad_telemetry(
        &mut self,
        incident: Incident,
        text: std::fmt::Arguments,
        (time, speed_mph): (FrameTime, Option<f64>),
    ) -> Result<(), End> {
        self.fault(incident, text)?;
        self.answer_blind(time, speed_mph)
    }

    /// Answers telemetry that cannot be used, so that the car does not wait for ever: the helm holds the driven client's
    /// steering and then brakes; another client is asked again.
    pub(super) fn answer_blind(&mut self, time: FrameTime, speed_mph: Option<f64>) -> Result<(), End> {
        if self.shared.seat.is_held_by(self.peer.id, Instant::now()) {
            let command = self.helm.without_frame(time, speed_mph);
            self.steer(command)
        } else {
            self.ask()
        }
    }

    /// Tells the user if the car does not follow the throttle.
    fn check_throttle(&mut self, telemetry: &Telemetry, command: Command) {
        let shows_none = telemetry.throttle.is_some_and(|throttle| throttle == 0.0);
        let ignored =
            shows_none && command.throttle >= STRONG_THROTTLE && telemetry.speed_mph.is_some_and(|mph| mph < 1.0);
        self.ignored = if ignored { self.ignored + 1 } else { 0 };
        if self.ignored >= MAX_IGNORED {
            self.ignored = 0;
            let text = format_args!("{}: was given throttle {MAX_IGNORED} times and shows none", self.address);
            self.shared.journal.report(Incident::ThrottleIgnored, text);
        }
    }
}
