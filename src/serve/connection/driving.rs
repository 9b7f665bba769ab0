//! Telemetry in, command out.

use std::sync::PoisonError;
use std::sync::atomic::Ordering;
use std::time::Instant;

use data_encoding::BASE64;

use super::{Connection, End};
use crate::serve::helm::Clock;
use crate::serve::journal::Event;
use crate::serve::protocol::{ClientPacket, Command, DecimalMark, NumberStyle, Telemetry};
use crate::serve::recording::Queued;
use crate::serve::registry::Stage;
use crate::serve::seat::Claim;

/// Largest height or width of an image, pixels.
const MAX_IMAGE_SIDE: usize = 1920;
/// Throttle that must move a car.
const STRONG_THROTTLE: f32 = 0.2;
/// Commands with a strong throttle after which a car must show it.
const DEAF_AFTER: u32 = 40;

impl Connection<'_, '_> {
    /// Answers the newest telemetry, whose last byte came at `came`.
    pub(super) fn answer(&mut self, packet: ClientPacket, came: Instant) -> Result<(), End> {
        let telemetry = match packet {
            ClientPacket::Telemetry(telemetry, _) => telemetry,
            _ => return self.let_person_drive(came),
        };
        self.learn_style(&telemetry);
        if self.overridden {
            self.overridden = false;
            self.shared.journal.step(format_args!("{}: the model drives again", self.address));
        }
        let Some(image) = &telemetry.image else {
            return self.bad_telemetry(Event::NoImage, format_args!("telemetry without an image"));
        };
        let Some(speed_mph) = telemetry.speed_mph else {
            return self.bad_telemetry(Event::NoSpeed, format_args!("telemetry without a speed"));
        };
        let steering = match self.look(image) {
            Ok(steering) => steering,
            Err(text) => return self.bad_telemetry(Event::UnreadableImage, format_args!("{text}")),
        };
        match self.shared.seat.claim(self.peer.id, &self.peer.stream, Instant::now()) {
            Claim::Kept => {}
            Claim::Taken => {
                self.peer.set_stage(Stage::Trusted);
                self.waits = false;
                self.shared.journal.report(Event::Drives, format_args!("{} is driven", self.address));
            }
            // Another was faster; this client's token is kept by asking for its next telemetry.
            Claim::Refused => return self.ask(),
        }
        self.faults = 0;
        self.lockstep = telemetry.time_s.is_some();
        let clock = telemetry.time_s.map_or(Clock::Arrival(came), Clock::Simulated);
        let command = self.helm.command(steering, speed_mph, clock);
        self.steer(command)?;
        self.cut = false;
        self.shared.statistics().answered(came, Instant::now(), command, speed_mph);
        self.check_obedience(&telemetry, command);
        if let Some(recorder) = &self.shared.recorder {
            match recorder.push(clock, &self.image, command, speed_mph) {
                Queued::Yes => {}
                Queued::Dropped => {
                    self.shared.journal.report(Event::RecordingLags, format_args!("a frame could not be recorded"));
                }
                Queued::Failed => self.shared.recording_failed.store(true, Ordering::Relaxed),
            }
        }
        Ok(())
    }

    /// What the model says to an image in base64.
    fn look(&mut self, image: &str) -> Result<f32, String> {
        let len = BASE64.decode_len(image.len()).map_err(|_| "an image whose base64 is incomplete".to_string())?;
        self.image.resize(len, 0);
        let len = BASE64
            .decode_mut(image.as_bytes(), &mut self.image)
            .map_err(|partial| format!("an image that is not base64: {}", partial.error))?;
        self.image.truncate(len);
        let mut pilot = self.shared.pilot.lock().unwrap_or_else(PoisonError::into_inner);
        pilot
            .steer_encoded_within(&self.image, MAX_IMAGE_SIDE)
            .map_err(|error| format!("an image that cannot be used: {error}"))
    }

    fn learn_style(&mut self, telemetry: &Telemetry) {
        let style = telemetry.number_style();
        if style == self.style {
            return;
        }
        self.style = style;
        match style {
            NumberStyle::Numbers => {
                let text = format_args!("{}: a simulator of the second term (it sends `cte`)", self.address);
                self.shared.journal.report(Event::SecondTerm, text);
            }
            NumberStyle::Strings(mark) if mark != DecimalMark::DOT => {
                let text = format_args!("{}: writes numbers with the decimal mark `{}`", self.address, mark.char());
                self.shared.journal.report(Event::DecimalMark, text);
            }
            NumberStyle::Strings(_) => {}
        }
    }

    fn let_person_drive(&mut self, came: Instant) -> Result<(), End> {
        if !self.overridden {
            self.overridden = true;
            self.shared.journal.report(Event::Override, format_args!("{}: a person drives", self.address));
        }
        self.shared.seat.is_held_by(self.peer.id, came);
        self.helm.release();
        (self.deaf, self.cut) = (0, false);
        self.ask()
    }

    /// Telemetry by which nobody can drive.
    fn bad_telemetry(&mut self, event: Event, text: std::fmt::Arguments) -> Result<(), End> {
        self.fault(event, text)?;
        self.answer_blind()
    }

    /// Answers telemetry that could not be used: the driving client gets its throttle cut, another is asked again, so that
    /// the car does not wait for ever.
    pub(super) fn answer_blind(&mut self) -> Result<(), End> {
        if self.shared.seat.is_held_by(self.peer.id, Instant::now()) {
            let command = self.helm.cut_throttle();
            self.steer(command)
        } else {
            self.ask()
        }
    }

    /// Says so if the car shows none of the throttle it was given.
    fn check_obedience(&mut self, telemetry: &Telemetry, command: Command) {
        let shows_none = telemetry.throttle.is_some_and(|throttle| throttle == 0.0);
        let deaf =
            shows_none && command.throttle >= STRONG_THROTTLE && telemetry.speed_mph.is_some_and(|mph| mph < 1.0);
        self.deaf = if deaf { self.deaf + 1 } else { 0 };
        if self.deaf >= DEAF_AFTER {
            self.deaf = 0;
            let text = format_args!("{}: was given throttle {DEAF_AFTER} times and shows none", self.address);
            self.shared.journal.report(Event::ThrottleIgnored, text);
        }
    }
}
