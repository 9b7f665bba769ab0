//! `steersman predict`: an angle per image.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::{load_pilot, print, print_json};
use crate::error::Result;

/// Print the steering a model gives for images
#[derive(Debug, Args)]
pub struct PredictArgs {
    /// Model file
    model: PathBuf,
    /// JPEG or PNG images
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Print one JSON array as the last line: [{"image": …, "steering": …}, …]
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Answer {
    image: PathBuf,
    steering: f32,
}

pub fn run(args: PredictArgs) -> Result<()> {
    let mut pilot = load_pilot(&args.model)?;
    let full_lock_deg = pilot.recipe().full_lock_deg;
    let mut answers = Vec::new();
    for image in args.images {
        let steering = pilot.steer_file(&image)?;
        if !args.json {
            let angle_deg = f64::from(steering) * full_lock_deg;
            print(&format!("{steering:+.4}  {angle_deg:+6.2} deg  {}\n", image.display()))?;
        }
        answers.push(Answer { image, steering });
    }
    if args.json { print_json(&answers) } else { Ok(()) }
}
