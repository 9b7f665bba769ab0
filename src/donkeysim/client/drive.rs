//! The drive: from the menu into a scene, and run after run.

use std::time::{Duration, Instant};

use super::link::Link;
use super::options::{DonkeyDrive, DonkeyDriveOptions};
use super::run::Run;
use super::telemetry::{ServerMessage, Telemetry};
use crate::donkeysim::messages;
use crate::observer::{Observer, Progress};
use crate::picture::decode::image_size;
use crate::simulator::car::dynamics::MPS_PER_MPH;
use crate::simulator::trial::outcome::Failure;
use crate::simulator::{DriverAnswer, Speed, SpeedController};
use crate::simulator_client::ClientEvent;
use crate::text::excerpt;
use crate::{Error, Result};

/// Longest single wait, so that whoever wants to stop need not wait long.
const TICK: Duration = Duration::from_millis(100);
/// How much longer loading a scene may take than anything else.
const LOADING_PATIENCE: f64 = 12.0;
/// Time without a telemetry that can be driven by after which the car brakes.
const HOLD_TIME: Duration = Duration::from_millis(500);
/// Pause between settings, which the simulator would otherwise take for one message.
const SETTING_PAUSE: Duration = Duration::from_millis(100);
/// Time for which the car stands at the start after it was put back: what it hit before is told no more then.
const SETTLING_TIME: Duration = Duration::from_secs(1);
/// Most messages that are read before one is answered.
const MAX_ARRIVED: usize = 256;
/// Most notices: a hostile simulator must not fill the screen.
const MAX_NOTICES: usize = 20;
/// Most names of scenes that are listed.
const MAX_NAMES: usize = 40;
/// Most characters of a name that are shown.
const MAX_NAME_CHARS: usize = 40;
/// The scene that is chosen if none is named.
const USUAL_SCENE: &str = "generated_track";
/// Relative difference of two shapes of pictures that are the same.
const SAME_SHAPE: f64 = 0.02;

/// What the driver sees.
#[derive(Clone, Copy, Debug)]
pub struct DonkeyFrame<'a> {
    /// The picture as it arrived, encoded.
    pub picture: &'a [u8],
    /// All that came with it.
    pub telemetry: &'a Telemetry,
}

/// Whoever steers: an error says why a picture cannot be read.
pub type DonkeyDriver<'a> = dyn FnMut(DonkeyFrame) -> Result<DriverAnswer, String> + 'a;

/// Lets `driver` drive in the simulator of `options`. `observer` is told notices and progress; its error ends the drive.
///
/// Once the first run has begun, whatever ends the drive is [`DonkeyDrive::ended`], and what was driven until then is the result.
///
/// # Errors
///
/// [`Error::Usage`] for impossible options and for a scene that is not there, [`Error::Connection`] with the remedy if the simulator
/// cannot be reached, does not bring the car onto a track or leaves before the first run, and the observer's own until then.
pub fn drive(
    options: &DonkeyDriveOptions,
    driver: &mut DonkeyDriver,
    observer: &mut dyn Observer<ClientEvent>,
) -> Result<DonkeyDrive> {
    options.check()?;
    let link = Link::connect(&options.server)?;
    let mut client = Client {
        options,
        link,
        observer,
        notices: 0,
        began: Instant::now(),
        share: 0.0,
        drive: DonkeyDrive::default(),
    };
    client.enter()?;
    let ended = (0..options.runs).try_for_each(|run| client.run(run, driver)).err();
    // The car must not go on without a driver; the simulator may be gone.
    let _ = client.link.send(&control(0.0, 0.0, 1.0));
    match ended {
        Some(error) if client.drive.runs.is_empty() => Err(error),
        ended => Ok(DonkeyDrive { ended, ..client.drive }),
    }
}

struct Client<'a> {
    options: &'a DonkeyDriveOptions,
    link: Link,
    observer: &'a mut dyn Observer<ClientEvent>,
    notices: usize,
    began: Instant,
    /// Share of all laps that is driven, 0 to 1.
    share: f64,
    drive: DonkeyDrive,
}

fn control(steering: f64, throttle: f64, brake: f64) -> String {
    let share = |value: f64| format!("{value:.5}");
    messages::text("control", &[("steering", share(steering)), ("throttle", share(throttle)), ("brake", share(brake))])
}

/// The bytes of the picture.
fn decoded(telemetry: &Telemetry) -> Option<Vec<u8>> {
    data_encoding::BASE64.decode(telemetry.image.as_bytes()).ok()
}

impl Client<'_> {
    fn say(&mut self, text: String) -> Result<()> {
        self.notices += 1;
        if self.notices > MAX_NOTICES { Ok(()) } else { self.observer.observe(ClientEvent::Notice(text)) }
    }

    fn tick(&mut self) -> Result<()> {
        self.observer.observe(ClientEvent::Progress(Progress(self.share)))
    }

    /// Waits for a message that `find` takes; `what` is missing if none comes.
    fn wait_for<T>(&mut self, patience_s: f64, what: &str, find: impl Fn(ServerMessage) -> Option<T>) -> Result<T> {
        let began = Instant::now();
        while began.elapsed().as_secs_f64() < patience_s {
            self.tick()?;
            if let Some(found) = self.link.receive(TICK)?.and_then(&find) {
                return Ok(found);
            }
        }
        Err(self.link.error(format!("{what} within {patience_s} s")))
    }

    /// Goes from the greeting to a car with the settings of the options.
    fn enter(&mut self) -> Result<()> {
        let greeting = self.wait_for(
            self.options.patience_s,
            "it accepts the connection and says nothing; is this DonkeySim, and is its menu or a scene shown? Nothing arrived",
            |message| match message {
                ServerMessage::Menu => Some(true),
                ServerMessage::CarLoaded | ServerMessage::Telemetry(_) => Some(false),
                _ => None,
            },
        )?;
        if greeting {
            self.choose_scene()?;
        } else if let Some(scene) = &self.options.scene {
            let scene = excerpt(scene, MAX_NAME_CHARS);
            self.say(format!(
                "the simulator is in a scene already, which is driven; to drive `{scene}`, go back to its menu first"
            ))?;
        }
        for setting in [self.car_config(), self.cam_config()] {
            std::thread::sleep(SETTING_PAUSE);
            self.link.send(&setting)?;
        }
        std::thread::sleep(SETTING_PAUSE);
        Ok(())
    }

    fn choose_scene(&mut self) -> Result<()> {
        self.link.send(&messages::text("get_scene_names", &[]))?;
        let names =
            self.wait_for(self.options.patience_s, "its menu does not name its scenes", |message| match message {
                ServerMessage::SceneNames(names) => Some(names),
                _ => None,
            })?;
        let shown =
            names.iter().take(MAX_NAMES).map(|name| excerpt(name, MAX_NAME_CHARS)).collect::<Vec<_>>().join(", ");
        let wanted = self.options.scene.as_deref();
        let found = match wanted {
            Some(_) => names.iter().find(|name| Some(name.as_str()) == wanted),
            None => names.iter().find(|name| *name == USUAL_SCENE).or(names.first()),
        };
        let Some(name) = found else {
            let wanted = excerpt(wanted.unwrap_or_default(), MAX_NAME_CHARS);
            return Err(match names.is_empty() {
                true => self.link.error("its menu has no scenes; choose one in its window"),
                false => Error::Usage(format!("--scene {wanted}: the simulator has no such scene; it has {shown}")),
            });
        };
        if wanted.is_none() {
            self.say(format!(
                "scenes of the simulator: {shown}; {} is driven, --scene chooses",
                excerpt(name, MAX_NAME_CHARS)
            ))?;
        }
        std::thread::sleep(SETTING_PAUSE);
        self.link.send(&messages::text("load_scene", &[("scene_name", name.clone())]))?;
        let what = format!("the scene `{}` is not loaded", excerpt(name, MAX_NAME_CHARS));
        self.wait_for(LOADING_PATIENCE * self.options.patience_s, &what, |message| {
            matches!(message, ServerMessage::CarLoaded | ServerMessage::Telemetry(_)).then_some(())
        })?;
        self.drive.scene = Some(excerpt(name, MAX_NAME_CHARS));
        Ok(())
    }

    fn car_config(&self) -> String {
        let rgb = [("body_r", "40"), ("body_g", "90"), ("body_b", "200"), ("font_size", "60")];
        let mut fields = vec![("body_style", "donkey".to_string()), ("car_name", self.options.car_name.clone())];
        fields.extend(rgb.map(|(name, value)| (name, value.to_string())));
        messages::text("car_config", &fields)
    }

    /// Asks for pictures of the model's size; what is 0 stays as the simulator has it.
    fn cam_config(&self) -> String {
        let [height, width] = self.options.picture;
        let mut fields = vec![
            ("img_w", width.to_string()),
            ("img_h", height.to_string()),
            ("img_d", "3".into()),
            ("img_enc", "JPG".into()),
        ];
        for name in super::options::CAMERA_SETTINGS {
            let given = self.options.camera.iter().find(|(setting, _)| setting == name);
            fields.push((name, given.map_or("0".into(), |(_, value)| value.to_string())));
        }
        messages::text("cam_config", &fields)
    }

    /// Drives the run `index`, from 0, and keeps it however it ends.
    fn run(&mut self, index: usize, driver: &mut DonkeyDriver) -> Result<()> {
        self.drive.last_run = index + 1;
        self.put_back()?;
        let mut run = Run::new(self.options.scale, self.options.max_cte);
        let ended = self.drive_run(&mut run, index, driver);
        if ended.is_ok() && !run.counts_laps() && run.laps_completed() == 0 {
            self.say("the simulator tells nothing from which laps can be counted: no starting line, no nodes".into())?;
        }
        self.drive.runs.push(run.finish(self.options.laps));
        ended
    }

    /// Puts the car back to the start, where it stands for a while.
    fn put_back(&mut self) -> Result<()> {
        self.link.send(&control(0.0, 0.0, 1.0))?;
        std::thread::sleep(SETTING_PAUSE);
        self.link.send(&messages::text("reset_car", &[]))?;
        std::thread::sleep(SETTING_PAUSE);
        self.link.send(&control(0.0, 0.0, 1.0))?;
        let began = Instant::now();
        while began.elapsed() < SETTLING_TIME {
            self.tick()?;
            self.link.receive(TICK.min(SETTLING_TIME.saturating_sub(began.elapsed())))?;
        }
        Ok(())
    }

    fn drive_run(&mut self, run: &mut Run, index: usize, driver: &mut DonkeyDriver) -> Result<()> {
        let mut controller = SpeedController::default();
        let began = Instant::now();
        let patience = Duration::from_secs_f64(self.options.patience_s);
        let (mut last_telemetry, mut last_good) = (began, began);
        let (mut steering, mut has_braked, mut trouble) = (0.0, false, String::new());
        while !run.is_over() && run.laps_completed() < self.options.laps {
            if began.elapsed().as_secs_f64() > self.options.time_limit_s {
                return self.say(format!(
                    "run {} ends at its time limit of {} s; --time-limit gives more",
                    index + 1,
                    self.options.time_limit_s
                ));
            }
            let laps = (index * self.options.laps) as f64 + run.laps_driven();
            self.share = (laps / (self.options.runs * self.options.laps) as f64).clamp(0.0, 1.0);
            self.tick()?;
            let telemetry = self.newest(run)?;
            let now = Instant::now();
            let Some(telemetry) = telemetry else {
                if now - last_telemetry > patience {
                    return Err(self.link.error(format!(
                        "no telemetry for {} s; is the simulator paused, in its menu, or its machine overloaded?",
                        self.options.patience_s
                    )));
                }
                if now - last_good > HOLD_TIME && !has_braked {
                    self.link.send(&control(steering, 0.0, 1.0))?;
                    has_braked = true;
                }
                continue;
            };
            last_telemetry = now;
            if run.is_over() {
                break;
            }
            match self.answer(run, &telemetry, &mut controller, driver) {
                Ok((of_model, throttle)) => {
                    (steering, last_good, has_braked) = (of_model, now, false);
                    if self.drive.answered == 0 {
                        self.compare_shape(&telemetry)?;
                    }
                    self.link.send(&control(steering, throttle.max(0.0), (-throttle).max(0.0)))?;
                    run.answer(&telemetry, steering, throttle);
                    self.drive.answered += 1;
                    self.drive.answers_ms.push(now.elapsed().as_secs_f64() * 1e3);
                }
                Err(what) => {
                    self.drive.unreadable += 1;
                    if what != trouble {
                        trouble = what;
                        self.say(format!(
                            "a telemetry cannot be driven by: {trouble}; the wheel is held, then the car brakes"
                        ))?;
                    }
                    if now - last_good > patience {
                        return Err(self.link.error(format!(
                            "for {} s no telemetry can be driven by: {trouble}; speed and a picture, JPEG or PNG in Base64, are needed",
                            self.options.patience_s
                        )));
                    }
                    let brake = if now - last_good > HOLD_TIME { 1.0 } else { 0.0 };
                    self.link.send(&control(steering, 0.0, brake))?;
                }
            }
        }
        if let Some(failure) = run.failure() {
            let what = match failure {
                Failure::Crash => "hit something",
                Failure::LeftRoad => "left the road",
                Failure::StoodStill => "stood still for 10 s",
                Failure::Disqualified => "is disqualified",
            };
            self.say(format!("run {} ends after {:.1} s: the car {what}", index + 1, run.time_s()))?;
        }
        Ok(())
    }

    /// The newest telemetry; all messages that have arrived are taken notice of.
    fn newest(&mut self, run: &mut Run) -> Result<Option<Telemetry>> {
        let mut newest: Option<Telemetry> = None;
        for read in 0..MAX_ARRIVED {
            let message = if read == 0 { self.link.receive(TICK)? } else { self.link.receive_arrived()? };
            match message {
                None => break,
                Some(ServerMessage::Telemetry(telemetry)) => {
                    run.see(&telemetry, self.began.elapsed().as_secs_f64());
                    self.drive.superseded += u64::from(newest.is_some());
                    newest = Some(*telemetry);
                }
                Some(ServerMessage::StartingLine(index)) => run.cross_line(index),
                Some(ServerMessage::LapTime(lap_time_s)) => run.time_lap(lap_time_s),
                Some(ServerMessage::Disqualified(why)) => {
                    run.fail(Failure::Disqualified);
                    self.say(why.into())?;
                }
                Some(ServerMessage::Menu) => {
                    return Err(self.link.error("the scene was left for the menu; start the drive again"));
                }
                Some(_) => {}
            }
        }
        Ok(newest)
    }

    /// Steering and throttle, [-1, 1], for a telemetry, or why there are none.
    fn answer(
        &self,
        run: &Run,
        telemetry: &Telemetry,
        controller: &mut SpeedController,
        driver: &mut DonkeyDriver,
    ) -> Result<(f64, f64), String> {
        let speed_mph = run.speed_mps(telemetry).ok_or("it has no `speed`")? / MPS_PER_MPH;
        if telemetry.image.is_empty() {
            return Err("it has no `image`".into());
        }
        let picture = decoded(telemetry).ok_or("its `image` is no Base64")?;
        let answer = driver(DonkeyFrame { picture: &picture, telemetry })?;
        let (time_s, limit_mph) = (run.time_s(), self.limit_mph());
        let throttle = match (self.options.speed, answer.pace) {
            (Speed::Driver(_), Some(pace)) => controller.throttle_for(pace, time_s, limit_mph, speed_mph),
            _ => controller.throttle_at(time_s, limit_mph, speed_mph),
        };
        let usable = |value: f32| if value.is_finite() { f64::from(value).clamp(-1.0, 1.0) } else { 0.0 };
        Ok((usable(answer.steering), usable(throttle)))
    }

    fn limit_mph(&self) -> f64 {
        match self.options.speed {
            Speed::Fixed(mph) | Speed::Driver(mph) => mph,
            // Refused when the options were checked.
            Speed::Auto => 0.0,
        }
    }

    /// Says if the pictures have another shape than those that were asked for.
    fn compare_shape(&mut self, telemetry: &Telemetry) -> Result<()> {
        let picture = decoded(telemetry).unwrap_or_default();
        let Ok([height, width]) = image_size(&picture) else { return Ok(()) };
        let [wanted_height, wanted_width] = self.options.picture;
        let shape = (width * wanted_height) as f64 / ((height * wanted_width).max(1)) as f64;
        if (shape - 1.0).abs() <= SAME_SHAPE {
            return Ok(());
        }
        self.say(format!(
            "note: the simulator's pictures are {width}x{height}, of another shape than the {wanted_width}x{wanted_height} of the model, \
             which sees them distorted"
        ))
    }
}
