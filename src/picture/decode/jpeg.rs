//! JPEG: whether all of its data are there, and how the camera was held.

use image::metadata::Orientation;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::check_pixels;
use crate::picture::RgbImage;

pub(super) fn decode_jpeg(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
    let lenient = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::RGB)
        .set_max_width(max_side)
        .set_max_height(max_side)
        .set_strict_mode(false);
    let failed = |error: zune_jpeg::errors::DecodeErrors| format!("the JPEG cannot be decoded: {error:?}");
    // The decoder goes on with grey where an end marker comes too early. What stands in its place here shows how far the data
    // reach: those of a whole picture end before the decoder, which reads 8 bytes ahead, has used it up.
    let scan = Scan::of(bytes)?;
    let data = match scan.progressive {
        Some(all) if !(scan.ended && all) => return Err("the JPEG is truncated".into()),
        Some(_) => [&bytes[..scan.end], &NO_CODE, &[0xff, 0xd9]].concat(),
        None => [&bytes[..scan.end], &[0; AHEAD]].concat(),
    };
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(&data), lenient);
    decoder.decode_headers().map_err(failed)?;
    let (width, height) = decoder.dimensions().ok_or("the JPEG has no size")?;
    check_pixels(height, width)?;
    image.pixels.resize(width * height * 3, 0);
    if decoder.output_buffer_size() != Some(image.pixels.len()) {
        return Err("the JPEG has colours that cannot be turned into RGB".into());
    }
    decoder.set_options(lenient.set_strict_mode(true));
    decoder.decode_into(&mut image.pixels).map_err(|error| match error {
        zune_jpeg::errors::DecodeErrors::ExhaustedData
        | zune_jpeg::errors::DecodeErrors::FormatStatic("Premature end of buffer") => "the JPEG is truncated".into(),
        other => failed(other),
    })?;
    (image.height, image.width) = (height, width);
    let orientation = decoder.exif().and_then(|exif| Orientation::from_exif_chunk(exif));
    if let Some(orientation) = orientation.filter(|orientation| *orientation != Orientation::NoTransforms) {
        turn(image, orientation);
    }
    Ok(())
}

/// Bytes behind the picture data that the decoder may read ahead, and some more.
const AHEAD: usize = 16;
/// As many ones, as picture data have them: no Huffman code consists of ones alone, so whoever reads on stops with an error. Where
/// zeros are a code, one of them may end all the blocks that a pass of a progressive picture lacks.
const NO_CODE: [u8; 2 * AHEAD] = {
    let mut bytes = [0; 2 * AHEAD];
    let mut i = 0;
    while i < bytes.len() {
        bytes[i] = 0xff;
        i += 2;
    }
    bytes
};

/// Where the picture data of a JPEG end.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Scan {
    /// First byte behind the data: the end marker, or the end of the file.
    pub end: usize,
    /// Whether an end marker stands there.
    ended: bool,
    /// For data that come in several passes over the picture: whether these send every bit of every coefficient.
    progressive: Option<bool>,
}

/// Coefficients of a block.
const COEFFICIENTS: usize = 64;

/// What the passes of a progressive picture have sent.
#[derive(Default)]
struct Passes {
    /// For each component, by its identifier: the bits that each coefficient still lacks.
    lacking: Vec<(u8, [u8; COEFFICIENTS])>,
}

impl Passes {
    /// Takes note of the frame header `segment`, which names the components.
    fn frame(&mut self, segment: &[u8]) {
        let components = segment.get(6..).unwrap_or_default().as_chunks::<3>().0;
        self.lacking = components.iter().map(|component| (component[0], [u8::MAX; COEFFICIENTS])).collect();
    }

    /// Takes note of the scan header `segment`.
    fn scan(&mut self, segment: &[u8]) {
        let [count, rest @ ..] = segment else { return };
        let Some((components, [start, end, bits])) = rest.split_at_checked(2 * usize::from(*count)) else { return };
        for [id, _] in components.as_chunks::<2>().0 {
            let of_component = self.lacking.iter_mut().filter(|(component, _)| component == id);
            for (_, lacking) in of_component {
                let sent = usize::from(*start)..COEFFICIENTS.min(usize::from(*end) + 1);
                lacking.get_mut(sent).unwrap_or_default().fill(bits & 0x0f);
            }
        }
    }

    fn sent_all(&self) -> bool {
        self.lacking.iter().all(|(_, lacking)| lacking.iter().all(|&bits| bits == 0))
    }
}

/// Index of the first byte 0xff. Blocks without one are passed by as a whole, which vectorises.
fn first_0xff(bytes: &[u8]) -> Option<usize> {
    let (blocks, _) = bytes.as_chunks::<32>();
    let has_one = |block: &[u8; 32]| block.iter().fold(false, |found, &byte| found | (byte == 0xff));
    let begin = 32 * blocks.iter().position(has_one).unwrap_or(blocks.len());
    Some(begin + bytes[begin..].iter().position(|&byte| byte == 0xff)?)
}

impl Scan {
    pub fn of(bytes: &[u8]) -> Result<Scan, String> {
        let truncated = || "the JPEG is truncated".to_string();
        let (mut at, mut passes) = (2, None::<Passes>);
        let found = |end: usize, ended: bool, passes: &Option<Passes>| Scan {
            end,
            ended,
            progressive: passes.as_ref().map(Passes::sent_all),
        };
        loop {
            // Segments, each with its length, up to the picture data.
            let marker = loop {
                let pair = bytes.get(at..at + 2).ok_or_else(truncated)?;
                match pair {
                    [0xff, 0xff] => at += 1,
                    [0xff, marker] if *marker != 0 => break *marker,
                    // Some cameras leave bytes between segments.
                    _ => at += 1,
                }
            };
            at += 2;
            match marker {
                0xd9 => return Ok(found(at - 2, true, &passes)),
                0x01 | 0xd0..=0xd8 => continue,
                _ => {}
            }
            let length = bytes.get(at..at + 2).ok_or_else(truncated)?;
            let next = at + usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
            let segment = bytes.get(at + 2..next).unwrap_or_default();
            at = next;
            match marker {
                0xc2 | 0xc6 | 0xca | 0xce => passes.get_or_insert_default().frame(segment),
                0xda => passes.iter_mut().for_each(|passes| passes.scan(segment)),
                _ => {}
            }
            if marker != 0xda {
                continue;
            }
            // Picture data: 0xff is followed by 0 or a restart marker, up to the next segment.
            loop {
                let place = bytes.get(at..).and_then(first_0xff);
                let Some(marker) = place else { return Ok(found(bytes.len(), false, &passes)) };
                at += marker;
                match bytes.get(at + 1) {
                    None => return Ok(found(at, false, &passes)),
                    Some(0 | 0xd0..=0xd7) => at += 2,
                    Some(0xff) => at += 1,
                    Some(_) => break,
                }
            }
        }
    }
}

/// Turns and mirrors a picture that was taken with the camera in another position.
fn turn(image: &mut RgbImage, orientation: Orientation) {
    let (width, height) = (image.width as u32, image.height as u32);
    let Some(pixels) = image::RgbImage::from_raw(width, height, std::mem::take(&mut image.pixels)) else { return };
    let mut picture = image::DynamicImage::ImageRgb8(pixels);
    picture.apply_orientation(orientation);
    (image.height, image.width) = (picture.height() as usize, picture.width() as usize);
    image.pixels = picture.into_rgb8().into_raw();
}
