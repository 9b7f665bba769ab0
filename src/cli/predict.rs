//! `steersman predict`: an angle per image.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::{end_with, load_pilot, print, print_json};
use crate::error::{Error, Result};

/// Print the steering a model gives for images
#[derive(Debug, Args)]
pub struct PredictArgs {
    /// Model file
    model: PathBuf,
    /// JPEG or PNG images
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Print one JSON array as the last line: [{"image": …, "steering": …}, …], with "error" in the
    /// place of "steering" where an image cannot be read
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Answer {
    image: PathBuf,
    #[serde(skip_serializing_if = "Option::is_none")]
    steering: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

pub fn run(args: PredictArgs) -> Result<()> {
    let mut pilot = load_pilot(&args.model)?;
    let full_lock_deg = pilot.recipe().full_lock_deg;
    let (mut answers, mut failed): (Vec<Answer>, Vec<Error>) = Default::default();
    for image in args.images {
        match pilot.steer_file(&image) {
            Ok(steering) => {
                if !args.json {
                    let angle_deg = f64::from(steering) * full_lock_deg;
                    print(&format!("{steering:+.4}  {angle_deg:+6.2} deg  {}\n", image.display()))?;
                }
                answers.push(Answer { image, steering: Some(steering), error: None });
            }
            // The other pictures are looked at all the same.
            Err(error) => {
                answers.push(Answer { image, steering: None, error: Some(error.to_string()) });
                failed.push(error);
            }
        }
    }
    if args.json {
        print_json(&answers)?;
    }
    end_with(failed)
}
