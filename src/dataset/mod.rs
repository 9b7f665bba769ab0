//! Recordings: reading, splitting, preprocessing and loading them.
//!
//! The way of a frame to the network:
//! 1. [`load()`] reads a recording, finds its images and leaves out rows that cannot be used;
//! 2. [`split::split`] divides the rows into training and validation, before anything is augmented;
//! 3. [`loader::Loader`] decodes each image once, preprocesses it ([`preprocess`]), keeps it ([`cache`]), augments
//!    training images ([`augment`]) and hands out batches.
//!
//! Labels are steering in [-1, 1], + = right. Side cameras and shifts move them, mirrors negate them; they are never
//! clamped. A recipe may ask for a second label, throttle or speed ([`Outputs`]), which nothing of that touches. [`leak`] measures what the training side gives away of the validation side, [`inspect`] describes a
//! recording for people.

mod description;
mod driven;
mod exclusions;
mod formats;
pub mod held_out;
pub mod inspect;
mod load;
mod pictures;
mod recording;
mod rows;
mod samples;
mod store;
mod unusable;

pub use description::{Column, ColumnRef, DESCRIPTION_FILE, Description, Labels, Unit, parse_columns};
pub use driven::{DrivenSession, DrivenSessions};
pub use exclusions::Exclusions;
pub use formats::{table as table_of_formats, udacity_writer};
pub(crate) use load::load_rows;
pub use load::{load, load_with, recordings_below};
pub(crate) use pictures::blur;
pub use pictures::{cache, colour, preprocess, resize};
pub use recording::{Recording, Row, SESSION_GAP_MS, View};
pub use rows::ImageCheck;
pub(crate) use rows::{LeftOut, NO_NUMBER};
pub use samples::{
    Balance, Correction, EXPERT_AHEAD_M, Flip, Group, Item, LabelKind, LabelSpec, Mirror, OutputKind, OutputSpec,
    Outputs, SampleSpec, Targets, augment, leak, loader, split, takeover, whole,
};
pub use unusable::{Reason, Tally, Unusable};

#[cfg(test)]
pub(crate) mod testing;
