//! `steersman predict`: an angle per image.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::arguments::load_pilot;
use super::process::end_with;
use super::terminal::{print, print_json};
use crate::error::{Error, Result};
use crate::evaluation::far_steering_notice;
use crate::pilot::Answer;

/// Print what a model gives for images: the steering, and throttle or speed if it has such an output
#[derive(Debug, Args)]
pub struct PredictArgs {
    /// Model file
    model: PathBuf,
    /// JPEG or PNG images
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Print one JSON array as the last line: [{"image": …, "steering": …}, …], with "throttle", or "speed" (a share of the top speed)
    /// and "speed_mph", of models that give one, and with "error" in the place of all that where an image cannot be read
    #[arg(long)]
    json: bool,
}

#[derive(Default, Serialize)]
struct Row {
    image: PathBuf,
    #[serde(skip_serializing_if = "Option::is_none")]
    steering: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    throttle: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    speed: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    speed_mph: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

pub fn run(args: PredictArgs) -> Result<()> {
    let mut pilot = load_pilot(&args.model)?;
    let full_lock_deg = pilot.recipe().full_lock_deg;
    let top_speed_mph = pilot.recipe().outputs.top_speed_mph().unwrap_or_default() as f32;
    let (mut answers, mut failed): (Vec<Row>, Vec<Error>) = Default::default();
    for image in args.images {
        match pilot.answer_file(&image) {
            Ok(Answer { steering, throttle, speed }) => {
                let speed_mph = speed.map(|share| share * top_speed_mph);
                if !args.json {
                    let angle_deg = f64::from(steering) * full_lock_deg;
                    let throttle = throttle.map_or(String::new(), |throttle| format!("  throttle {throttle:+.4}"));
                    let speed = speed_mph.map_or(String::new(), |mph| format!("  {mph:5.2} mph"));
                    print(&format!("{steering:+.4}  {angle_deg:+6.2} deg{throttle}{speed}  {}\n", image.display()))?;
                }
                let steering = Some(steering);
                answers.push(Row { image, steering, throttle, speed, speed_mph, error: None });
            }
            // The other pictures are looked at all the same.
            Err(error) => {
                answers.push(Row { image, error: Some(error.to_string()), ..Row::default() });
                failed.push(error);
            }
        }
    }
    let given = || answers.iter().filter_map(|row| row.steering);
    far_steering_notice(given()).iter().for_each(|notice| eprintln!("{notice}"));
    if args.json {
        print_json(&answers)?;
    }
    end_with(failed)
}
