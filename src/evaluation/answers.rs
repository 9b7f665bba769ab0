//! The answers of a model for many pictures, which is the work of an evaluation: it is shared out among the ranks.

use std::result::Result as StdResult;

use serde::{Deserialize, Serialize};

use crate::cluster::message::{Message, join, split};
use crate::cluster::tasks::Work;
use crate::error::{Error, Result};
use crate::picture::decode::MAX_SIDE;
use crate::pilot::{Answer, Pilot};

/// Pictures of a task at most: some, so that a message costs little beside them.
pub(super) const TASK_PICTURES: usize = 64;

/// The model that answers.
pub(crate) struct Answers(pub Pilot);

/// A picture: where it lies, and its file, or why that could not be read.
pub(crate) type Picture = (String, StdResult<Vec<u8>, String>);

/// The pictures of a task.
pub(crate) struct Pictures(pub Vec<Picture>);

/// What the model gave for each picture, or why it gave nothing.
pub(crate) struct Answered(pub Vec<StdResult<Answer, String>>);

impl Work for Answers {
    const NAME: &'static str = "answer";
    type Task = Pictures;
    type Done = Answered;

    fn perform(&self, task: Pictures) -> Result<Answered> {
        let mut pilot = self.0.clone();
        let answer = |(place, file): Picture| {
            let named = |error: Error| Error::data(&place, error.to_string()).to_string();
            file.and_then(|file| pilot.answer_encoded_within(&file, MAX_SIDE).map_err(named))
        };
        Ok(Answered(task.0.into_iter().map(answer).collect()))
    }
}

impl Message for Answers {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        self.0.to_bytes()
    }

    fn of_bytes(bytes: &[u8]) -> Result<Answers> {
        Pilot::of_bytes(bytes).map(Answers)
    }
}

const READ: u8 = 1;

impl Message for Pictures {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let parts = self.0.iter().flat_map(|(place, picture)| {
            let tagged = match picture {
                Ok(file) => [&[READ], &file[..]].concat(),
                Err(trouble) => [&[0], trouble.as_bytes()].concat(),
            };
            [place.clone().into_bytes(), tagged]
        });
        Ok(join(parts))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Pictures> {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        let picture = |parts: &[&[u8]]| {
            let picture = match parts[1].split_first() {
                Some((&READ, file)) => Ok(file.to_vec()),
                other => Err(other.map_or(String::new(), |(_, trouble)| text(trouble))),
            };
            (text(parts[0]), picture)
        };
        Ok(Pictures(split(bytes)?.chunks_exact(2).map(picture).collect()))
    }
}

/// An [`Answered`] picture with the bits of its numbers, which may be none.
#[derive(Serialize, Deserialize)]
enum Told {
    Answer(u32, Option<u32>, Option<u32>),
    Trouble(String),
}

impl Message for Answered {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let told = self.0.iter().map(|answer| match answer {
            Ok(Answer { steering, throttle, speed }) => {
                Told::Answer(steering.to_bits(), throttle.map(f32::to_bits), speed.map(f32::to_bits))
            }
            Err(trouble) => Told::Trouble(trouble.clone()),
        });
        told.collect::<Vec<_>>().to_bytes()
    }

    fn of_bytes(bytes: &[u8]) -> Result<Answered> {
        let answer = |told| match told {
            Told::Answer(steering, throttle, speed) => Ok(Answer {
                steering: f32::from_bits(steering),
                throttle: throttle.map(f32::from_bits),
                speed: speed.map(f32::from_bits),
            }),
            Told::Trouble(trouble) => Err(trouble),
        };
        Ok(Answered(Vec::<Told>::of_bytes(bytes)?.into_iter().map(answer).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_and_answers_come_back_as_they_were_sent() {
        let [a, b, c] = ["a", "", "c ä"].map(String::from);
        let pictures = Pictures(vec![(a, Ok(vec![3, 1, 0])), (b, Err("gone".into())), (c, Ok(vec![]))]);
        assert_eq!(Pictures::of_bytes(&pictures.to_bytes().unwrap()).unwrap().0, pictures.0);
        let answers = [
            Ok(Answer { steering: -0.0, throttle: Some(f32::INFINITY), speed: None }),
            Err("no picture".into()),
            Ok(Answer { steering: f32::NAN, throttle: None, speed: Some(0.1) }),
        ];
        let sent = Answered::of_bytes(&Answered(answers.to_vec()).to_bytes().unwrap()).unwrap().0;
        assert!(sent[..2] == answers[..2] && sent[0].as_ref().unwrap().steering.is_sign_negative());
        let Ok(last) = &sent[2] else { panic!("{:?}", sent[2]) };
        assert!(last.steering.is_nan() && last.speed == Some(0.1));
    }
}
