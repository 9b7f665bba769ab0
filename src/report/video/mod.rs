//! Videos of drives: the camera's picture, who steers how, and the way on the map, as H.264 in an MP4 file.
//!
//! [`drive`], [`replay`] and [`recording`] say what there is to see: a run as it is driven, one that was saved, and a
//! recording. They hand frames to [`film`], which lets [`painter`] paint them, gives each the time it lasted (`timeline`)
//! and writes the [`mod@file`]. An [`onlooker`] is a model that steers beside the driver.

pub mod drive;
pub mod file;
pub mod film;
mod lettering;
mod mp4;
pub mod on_recording;
pub mod onlooker;
pub mod painter;
pub mod recording;
pub mod replay;
pub mod summary;
mod timeline;
