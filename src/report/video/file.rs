//! Pictures as H.264 (Main profile, 4:2:0) in an MP4 file: what browsers, VLC and telephones play.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use rusty_h264_common::{Profile, YuvPlanes};
use rusty_h264_encoder::{Encoder, EncoderConfig, Preset};

use super::mp4::{Mp4Writer, TICKS_PER_S, TrackHeader};
use super::summary::VideoSummary;
use crate::error::{Error, Result};
use crate::files::atomic_file::NewFile;
use crate::picture::RgbImage;

/// Seconds between pictures that stand alone, to which a player can jump.
const KEY_S: f64 = 2.0;
/// Quantizer, 0 (best) to 51: text stays crisp, and two minutes of the simulator take 15 to 18 MB.
const QUANTIZER: u8 = 29;
/// H.264 level 3.1: up to 1280x720 pixels 30 times a second.
const LEVEL_IDC: u8 = 31;
/// Rates that can be written.
const FPS: std::ops::RangeInclusive<f64> = 1.0..=60.0;

/// A video file that grows picture by picture and has its name when it is finished. Dropped before, it leaves nothing behind.
pub struct VideoFile {
    place: NewFile,
    /// Begins with the first picture, which comes with the parameters that stand in the header.
    muxer: Option<Mp4Writer<BufWriter<File>>>,
    encoder: Encoder,
    size: [usize; 2],
    planes: Planes,
    ticks_per_frame: u32,
    frames: u64,
}

impl VideoFile {
    /// A new file of pictures of `size` = [height, width], both even.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for a name that does not end in `.mp4`, a file that exists or cannot be created, or an impossible rate.
    pub fn create(path: &Path, size: [usize; 2], fps: f64) -> Result<VideoFile> {
        check_name(path)?;
        check_fps(fps)?;
        let [height, width] = size;
        // Each picture comes out as it goes in: no reordering, no window of pictures to come.
        let mut config = EncoderConfig::baseline(width, height);
        config.preset = Preset::Fast;
        // Arithmetic coding saves about a fifth, and every player of today knows it.
        config.profile = Profile::Main;
        config.cabac = true;
        config.qp = QUANTIZER;
        config.level_idc = LEVEL_IDC;
        config.framerate = fps as f32;
        config.gop_size = (KEY_S * fps).round().max(1.0) as u32;
        let encoder = Encoder::new(config)
            .map_err(|e| Error::Codec(format!("pictures of {width}x{height} pixels make no video: {e}")))?;
        Ok(VideoFile {
            place: NewFile::create(path)?,
            muxer: None,
            encoder,
            size,
            planes: Planes::new(size),
            ticks_per_frame: (f64::from(TICKS_PER_S) / fps).round() as u32,
            frames: 0,
        })
    }

    /// Pictures for each second: the rate that was asked for, to the file's clock.
    pub fn fps(&self) -> f64 {
        f64::from(TICKS_PER_S) / f64::from(self.ticks_per_frame)
    }

    /// Pictures so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Adds a picture.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if it has another size, [`Error::CannotWrite`] if the disk is full, [`Error::Io`] if the file cannot be written.
    pub fn write(&mut self, picture: &RgbImage) -> Result<()> {
        let [height, width] = self.size;
        if [picture.height, picture.width] != self.size {
            let (h, w) = (picture.height, picture.width);
            return Err(Error::Input(format!("a picture of {w}x{h} pixels in a video of {width}x{height}")));
        }
        self.planes.take(picture);
        let unit = self
            .encoder
            .encode_planes(&self.planes.view(width, height))
            .map_err(|e| Error::Codec(format!("picture {} cannot be encoded: {e}", self.frames)))?;
        let unit = AccessUnit::parse(&unit);
        if self.muxer.is_none() {
            let header = TrackHeader {
                width: width as u16,
                height: height as u16,
                sequence: unit.sequence,
                picture: unit.picture,
                ticks_per_frame: self.ticks_per_frame,
            };
            let opened = Mp4Writer::begin(BufWriter::new(self.place.open()?), header);
            self.muxer = Some(opened.map_err(|e| self.place.explain(e))?);
        }
        let written = self.muxer.as_mut().map_or(Ok(()), |muxer| muxer.write(&unit.sample, unit.stands_alone));
        written.map_err(|e| self.place.explain(e))?;
        self.frames += 1;
        Ok(())
    }

    /// Writes the index and gives the file its name.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if there is no picture, [`Error::Usage`] if another program has created the file, [`Error::CannotWrite`] if
    /// the disk is full, [`Error::Io`] if it cannot be written.
    pub fn finish(mut self) -> Result<VideoSummary> {
        let Some(muxer) = self.muxer.take() else {
            return Err(Error::Input("a video without a picture is not written".into()));
        };
        muxer.finish().map_err(|e| self.place.explain(e))?;
        let (frames, fps) = (self.frames, self.fps());
        let bytes = self.place.finish()?;
        Ok(VideoSummary { frames, fps, seconds: frames as f64 / fps, bytes, unreadable: 0 })
    }
}

/// Refuses names whose ending promises another kind of file.
fn check_name(path: &Path) -> Result<()> {
    match path.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("mp4") => Ok(()),
        _ => {
            let named = path.with_extension("mp4");
            let remedy = format!("videos are written as .mp4 (H.264); name it {}", named.display());
            Err(Error::Usage(format!("{}: {remedy}", path.display())))
        }
    }
}

/// Refuses rates that cannot be written.
fn check_fps(fps: f64) -> Result<()> {
    match FPS.contains(&fps) {
        true => Ok(()),
        false => Err(Error::Usage(format!("{fps} pictures a second: {} to {} can be written", FPS.start(), FPS.end()))),
    }
}

/// One coded picture, taken apart as MP4 wants it (ISO/IEC 14496-15): parameter sets for the header, and the slices, each
/// behind its length instead of a start code.
struct AccessUnit {
    sequence: Vec<u8>,
    picture: Vec<u8>,
    sample: Vec<u8>,
    stands_alone: bool,
}

impl AccessUnit {
    /// Takes a byte stream of H.264, annex B, apart.
    fn parse(stream: &[u8]) -> AccessUnit {
        let mut unit = AccessUnit { sequence: vec![], picture: vec![], sample: vec![], stands_alone: false };
        for nal in nal_units(stream) {
            match nal[0] & 0x1f {
                7 => unit.sequence = nal.to_vec(),
                8 => unit.picture = nal.to_vec(),
                // Delimiters say nothing that the file does not.
                9 => {}
                kind => {
                    unit.stands_alone |= kind == 5;
                    unit.sample.extend((nal.len() as u32).to_be_bytes());
                    unit.sample.extend(nal);
                }
            }
        }
        unit
    }
}

/// The units between the start codes 00 00 01 of a byte stream, without the zeros that may stand before a start code.
fn nal_units(stream: &[u8]) -> impl Iterator<Item = &[u8]> {
    let starts: Vec<usize> =
        (stream.windows(3).enumerate()).filter(|(_, w)| w == &[0, 0, 1]).map(|(at, _)| at).collect();
    let ends: Vec<usize> = starts.iter().skip(1).copied().chain([stream.len()]).collect();
    starts.into_iter().zip(ends).filter_map(|(start, end)| {
        let nal = &stream[start + 3..end];
        // A unit never ends in a zero byte.
        let length = nal.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
        (length > 0).then(|| &nal[..length])
    })
}

/// A picture as the encoder wants it: luma, and both colour differences at half the size, with the range and the weights of
/// ITU-R BT.601, which players assume for pictures of this size.
struct Planes {
    y: Vec<u8>,
    u: Vec<u8>,
    v: Vec<u8>,
}

impl Planes {
    fn new([height, width]: [usize; 2]) -> Planes {
        let quarter = height.div_ceil(2) * width.div_ceil(2);
        Planes { y: vec![16; height * width], u: vec![128; quarter], v: vec![128; quarter] }
    }

    fn take(&mut self, picture: &RgbImage) {
        let width = picture.width;
        for (y, [r, g, b]) in self.y.iter_mut().zip(picture.pixels.as_chunks::<3>().0) {
            let [r, g, b] = [r, g, b].map(|level| i32::from(*level));
            *y = (16 + ((66 * r + 129 * g + 25 * b + 128) >> 8)) as u8;
        }
        for (row, lines) in picture.pixels.chunks_exact(2 * 3 * width).enumerate() {
            let (upper, lower) = lines.split_at(3 * width);
            for column in 0..width / 2 {
                // Sums of four pixels.
                let [r, g, b] = [0, 1, 2].map(|c| {
                    let at = 6 * column + c;
                    [upper[at], upper[at + 3], lower[at], lower[at + 3]].map(i32::from).iter().sum::<i32>()
                });
                let at = row * (width / 2) + column;
                self.u[at] = (128 + ((-38 * r - 74 * g + 112 * b + 512) >> 10)) as u8;
                self.v[at] = (128 + ((112 * r - 94 * g - 18 * b + 512) >> 10)) as u8;
            }
        }
    }

    fn view(&self, width: usize, height: usize) -> YuvPlanes<'_> {
        YuvPlanes { width, height, y: &self.y, u: &self.u, v: &self.v, stride_y: width, stride_c: width / 2 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_byte_stream_is_taken_apart_at_its_start_codes() {
        let stream = [0, 0, 0, 1, 0x67, 1, 2, 0, 0, 1, 0x68, 3, 0, 0, 0, 1, 9, 16, 0, 0, 1, 0x65, 0, 0, 3, 1, 7];
        let unit = AccessUnit::parse(&stream);
        assert_eq!((unit.sequence, unit.picture), (vec![0x67, 1, 2], vec![0x68, 3]));
        assert_eq!((unit.sample, unit.stands_alone), (vec![0, 0, 0, 6, 0x65, 0, 0, 3, 1, 7], true));
        assert!(!AccessUnit::parse(&[0, 0, 1, 0x41, 5]).stands_alone);
        assert!(AccessUnit::parse(&[]).sample.is_empty());
    }

    #[test]
    fn colours_have_the_levels_of_bt_601() {
        let levels = |rgb: [u8; 3]| {
            let mut planes = Planes::new([2, 2]);
            planes.take(&RgbImage::filled(2, 2, rgb));
            [planes.y[3], planes.u[0], planes.v[0]]
        };
        for (rgb, expected) in [
            ([0, 0, 0], [16, 128, 128]),
            ([255, 255, 255], [235, 128, 128]),
            ([255, 0, 0], [82, 90, 240]),
            ([0, 255, 0], [145, 54, 34]),
            ([0, 0, 255], [41, 240, 110]),
        ] {
            let close = levels(rgb).iter().zip(expected).all(|(a, b): (&u8, u8)| a.abs_diff(b) <= 1);
            assert!(close, "{rgb:?} {:?}", levels(rgb));
        }
    }

    #[test]
    fn impossible_videos_are_refused_with_a_remedy_and_leave_nothing_behind() {
        let scratch = tempfile::tempdir().unwrap();
        let message = |name: &str, fps| match VideoFile::create(&scratch.path().join(name), [32, 32], fps) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{name} was accepted"),
        };
        assert!(message("a.avi", 20.0).contains("name it") && message("a", 20.0).contains("a.mp4"));
        assert!(message("a.mp4", 0.0).contains("1 to 60") && message("a.mp4", f64::NAN).contains("NaN"));
        let mut video = VideoFile::create(&scratch.path().join("a.MP4"), [32, 32], 20.0).unwrap();
        assert!(video.write(&RgbImage::filled(32, 30, [0; 3])).unwrap_err().to_string().contains("30x32"));
        assert!(video.finish().unwrap_err().to_string().contains("without a picture"));
        assert_eq!(std::fs::read_dir(scratch.path()).unwrap().count(), 0);
    }
}
