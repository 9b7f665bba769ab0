//! Decoding of JPEG and PNG images to 8-bit RGB.

use image::ImageDecoder as _;
use image::metadata::Orientation;
use std::borrow::Cow;
use std::io::Cursor;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::RgbImage;

/// Largest height or width that is decoded, in pixels.
pub const MAX_SIDE: usize = 8192;

/// Most pixels of an image that is decoded: 16 megapixels.
pub const MAX_PIXELS: usize = 16 << 20;

/// Longest file of a picture that is read, bytes.
pub const MAX_FILE_LEN: u64 = 64 << 20;

/// Most memory that decoding a PNG may take, bytes.
const MAX_DECODED_LEN: u64 = 64 << 20;

/// First bytes of every PNG file.
const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Decodes a JPEG or PNG file held in `bytes` into `image`, upright if its EXIF data say how it was held.
///
/// A JPEG whose picture data end early is an error, not a picture with a grey bottom, whether it has an end marker or not.
/// What stands behind the end marker is ignored: some cameras pad their files.
///
/// # Errors
/// A short sentence that says what is wrong with the image; the caller knows its place.
pub fn decode_rgb(bytes: &[u8], image: &mut RgbImage) -> Result<(), String> {
    decode_rgb_within(bytes, MAX_SIDE, image)
}

/// [`decode_rgb`] for images of strangers: what is higher or wider than `max_side` pixels is not decoded.
///
/// # Errors
/// As [`decode_rgb`].
pub fn decode_rgb_within(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
    if bytes.is_empty() {
        Err("the image is empty".into())
    } else if bytes.starts_with(PNG_SIGNATURE) {
        decode_png(bytes, max_side, image)
    } else if bytes.starts_with(&[0xff, 0xd8]) {
        decode_jpeg(bytes, max_side, image)
    } else {
        Err("neither a JPEG nor a PNG image".into())
    }
}

/// Height and width of a JPEG or PNG image as it is decoded, from its header alone.
///
/// # Errors
/// As [`decode_rgb`].
pub fn image_size(bytes: &[u8]) -> Result<[usize; 2], String> {
    if bytes.starts_with(PNG_SIGNATURE) {
        // Other readers would unpack the profiles and texts that stand before the pixels.
        let number = |at: usize| Some(u32::from_be_bytes(*bytes.get(at..)?.first_chunk()?) as usize);
        return match (bytes.get(12..16), number(20), number(16)) {
            (Some(b"IHDR"), Some(height), Some(width)) => Ok([height, width]),
            _ => Err("the PNG has no header".into()),
        };
    }
    let reader = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let mut decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    let (width, height) = decoder.dimensions();
    let [height, width] = [height as usize, width as usize];
    let is_jpeg = bytes.starts_with(&[0xff, 0xd8]);
    let turned = is_jpeg && decoder.orientation().is_ok_and(|orientation| orientation.to_exif() > 4);
    Ok(if turned { [width, height] } else { [height, width] })
}

/// Whether the last bytes of an image file hold the end marker of a JPEG or the last chunk of a PNG.
///
/// Some cameras pad the file, so the marker may stand a little before the end.
pub fn ends_complete(tail: &[u8]) -> bool {
    let tail = &tail[tail.len().saturating_sub(64)..];
    let ends_with = |marker: &[u8]| tail.windows(marker.len()).any(|window| window == marker);
    ends_with(&[0xff, 0xd9]) || ends_with(b"IEND")
}

/// Whether the first bytes of a file are those of a JPEG or PNG image.
pub fn starts_as_image(head: &[u8]) -> bool {
    head.starts_with(&[0xff, 0xd8]) || head.starts_with(PNG_SIGNATURE)
}

fn decode_jpeg(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
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
struct Scan {
    /// First byte behind the data: the end marker, or the end of the file.
    end: usize,
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
    fn of(bytes: &[u8]) -> Result<Scan, String> {
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

fn decode_png(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
    let [height, width] = image_size(bytes)?;
    check_pixels(height, width)?;
    let bytes = without_metadata(bytes);
    let mut reader = image::ImageReader::with_format(Cursor::new(&*bytes), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(max_side as u32);
    limits.max_image_height = Some(max_side as u32);
    limits.max_alloc = Some(MAX_DECODED_LEN);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|error| format!("the PNG cannot be decoded: {error}"))?.into_rgb8();
    (image.height, image.width) = (decoded.height() as usize, decoded.width() as usize);
    image.pixels.clear();
    image.pixels.extend_from_slice(decoded.as_raw());
    Ok(())
}

fn check_pixels(height: usize, width: usize) -> Result<(), String> {
    match height.checked_mul(width) {
        Some(pixels) if pixels <= MAX_PIXELS => Ok(()),
        _ => Err(format!("{width}x{height} pixels; at most 16 megapixels are decoded")),
    }
}

/// A PNG without the chunks that say nothing about its pixels: profiles and texts, of which a few bytes can unpack to
/// hundreds of megabytes.
fn without_metadata(bytes: &[u8]) -> Cow<'_, [u8]> {
    let mut kept = PNG_SIGNATURE.to_vec();
    let mut rest = &bytes[PNG_SIGNATURE.len()..];
    while let [a, b, c, d, kind @ ..] = rest
        && let Some(kind) = kind.first_chunk::<4>()
    {
        let len = u32::from_be_bytes([*a, *b, *c, *d]) as usize;
        // Length, kind and checksum stand around the content.
        let (chunk, after) = rest.split_at(len.saturating_add(12).min(rest.len()));
        if !matches!(kind, b"iCCP" | b"tEXt" | b"zTXt" | b"iTXt") {
            kept.extend_from_slice(chunk);
        }
        rest = after;
    }
    kept.extend_from_slice(rest);
    if kept.len() == bytes.len() { Cow::Borrowed(bytes) } else { Cow::Owned(kept) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageEncoder;

    fn gradient(width: usize, height: usize) -> Vec<u8> {
        (0..height).flat_map(|y| (0..width).flat_map(move |x| [(x * 3) as u8, (y * 5) as u8, 90])).collect()
    }

    fn jpeg(pixels: &[u8], width: u16, height: u16) -> Vec<u8> {
        let mut bytes = Vec::new();
        jpeg_encoder::Encoder::new(&mut bytes, 95).encode(pixels, width, height, jpeg_encoder::ColorType::Rgb).unwrap();
        bytes
    }

    #[test]
    fn jpeg_and_png_decode_to_the_same_picture() {
        let pixels = gradient(40, 24);
        let mut png = Vec::new();
        image::codecs::png::PngEncoder::new(&mut png)
            .write_image(&pixels, 40, 24, image::ExtendedColorType::Rgb8)
            .unwrap();
        let mut image = RgbImage::default();
        decode_rgb(&png, &mut image).unwrap();
        assert_eq!((image.height, image.width, &image.pixels), (24, 40, &pixels));
        let jpeg = jpeg(&pixels, 40, 24);
        decode_rgb(&jpeg, &mut image).unwrap();
        assert_eq!((image.height, image.width), (24, 40));
        let error: f64 = image.pixels.iter().zip(&pixels).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        assert!(error / (pixels.len() as f64) < 3.0, "mean error {}", error / pixels.len() as f64);
        assert_eq!(image_size(&jpeg), Ok([24, 40]));
        assert_eq!(image_size(&png), Ok([24, 40]));
    }

    #[test]
    fn too_large_an_image_is_not_decoded() {
        let mut image = RgbImage::default();
        let jpeg = jpeg(&gradient(40, 24), 40, 24);
        assert!(decode_rgb_within(&jpeg, 40, &mut image).is_ok());
        assert!(decode_rgb_within(&jpeg, 39, &mut image).is_err());
        let mut png = Vec::new();
        let encoder = image::codecs::png::PngEncoder::new(&mut png);
        encoder.write_image(&gradient(24, 40), 24, 40, image::ExtendedColorType::Rgb8).unwrap();
        assert!(decode_rgb_within(&png, 40, &mut image).is_ok());
        assert!(decode_rgb_within(&png, 39, &mut image).is_err());
    }

    #[test]
    fn a_png_whose_profile_unpacks_to_hundreds_of_megabytes_costs_no_more_than_its_pixels() {
        let mut png = Vec::new();
        let encoder = image::codecs::png::PngEncoder::new(&mut png);
        encoder.write_image(&gradient(24, 40), 24, 40, image::ExtendedColorType::Rgb8).unwrap();
        let mut plain = RgbImage::default();
        decode_rgb(&png, &mut plain).unwrap();

        let mut packed = flate2::write::ZlibEncoder::new(b"bomb\0\0".to_vec(), flate2::Compression::best());
        let zeros = vec![0; 1 << 20];
        (0..512).for_each(|_| std::io::Write::write_all(&mut packed, &zeros).unwrap());
        let packed = packed.finish().unwrap();
        let mut crc = flate2::Crc::new();
        crc.update(b"iCCP");
        crc.update(&packed);
        // Behind the signature and IHDR.
        let chunk = [&(packed.len() as u32).to_be_bytes(), &b"iCCP"[..], &packed, &crc.sum().to_be_bytes()].concat();
        let bomb = [&png[..33], &chunk, &png[33..]].concat();
        assert!(bomb.len() < 1 << 20);
        let kept = without_metadata(&bomb);
        assert_eq!(&*kept, &png[..], "nothing unpacks the profile");
        let mut image = RgbImage::default();
        decode_rgb(&bomb, &mut image).unwrap();
        assert!(image == plain && image_size(&bomb) == Ok([40, 24]));
    }

    #[test]
    fn more_than_16_megapixels_are_refused_before_they_take_memory() {
        let mut header = PNG_SIGNATURE.to_vec();
        header.extend(13u32.to_be_bytes());
        header.extend(b"IHDR");
        header.extend([8192u32.to_be_bytes(), 2049u32.to_be_bytes()].concat());
        header.extend([8, 2, 0, 0, 0, 0, 0, 0, 0]);
        let error = decode_rgb(&header, &mut RgbImage::default()).unwrap_err();
        assert!(error.contains("8192x2049 pixels; at most 16 megapixels"), "{error}");
    }

    #[test]
    fn a_grey_jpeg_becomes_rgb() {
        let mut bytes = Vec::new();
        jpeg_encoder::Encoder::new(&mut bytes, 95).encode(&[80; 64], 8, 8, jpeg_encoder::ColorType::Luma).unwrap();
        let mut image = RgbImage::default();
        decode_rgb(&bytes, &mut image).unwrap();
        assert!(image.pixels.len() == 192 && image.pixels.iter().all(|&x| x.abs_diff(80) <= 2));
    }

    #[test]
    fn pictures_of_every_kind_of_colour_are_read_or_named() {
        use image::ExtendedColorType::{L8, L16, La8, Rgb16, Rgba8};
        let (width, height) = (24, 16);
        let grey = |x: usize, y: usize| (x * 8 + y) as u8;
        for colour in [L8, L16, La8, Rgb16, Rgba8] {
            let channels = usize::from(colour.channel_count());
            let bytes = usize::from(colour.bits_per_pixel()) / 8 / channels;
            let value = |x: usize, y: usize, channel: usize| match (channels, channel) {
                (2, 1) | (4, 3) => 255,
                _ => grey(x, y),
            };
            let pixels: Vec<u8> = (0..height * width * channels)
                .flat_map(|i| vec![value(i / channels % width, i / channels / width, i % channels); bytes])
                .collect();
            let mut png = Vec::new();
            let encoder = image::codecs::png::PngEncoder::new(&mut png);
            encoder.write_image(&pixels, width as u32, height as u32, colour).unwrap();
            let mut image = RgbImage::default();
            decode_rgb(&png, &mut image).unwrap();
            assert_eq!((image.height, image.width), (height, width));
            assert_eq!(image.pixel(3, 20), [grey(20, 3); 3], "{colour:?}");
        }
        let mut cmyk = Vec::new();
        let encoder = jpeg_encoder::Encoder::new(&mut cmyk, 90);
        encoder.encode(&[90; 24 * 16 * 4], 24, 16, jpeg_encoder::ColorType::Cmyk).unwrap();
        let mut image = RgbImage::default();
        match decode_rgb(&cmyk, &mut image) {
            Ok(()) => assert_eq!((image.height, image.width), (height, width)),
            Err(message) => assert!(message.contains("colours"), "{message}"),
        }
    }

    #[test]
    fn broken_images_are_errors() {
        let whole = jpeg(&gradient(40, 24), 40, 24);
        let mut image = RgbImage::default();
        for length in [0, 1, 2, 20, whole.len() / 2] {
            assert!(decode_rgb(&whole[..length], &mut image).is_err(), "{length} bytes of {}", whole.len());
        }
        assert!(decode_rgb(b"GIF89a and so on", &mut image).is_err());
        assert!(decode_rgb(PNG_SIGNATURE, &mut image).is_err());
    }

    #[test]
    fn whether_a_picture_is_damaged_is_decided_by_its_data() {
        let (width, height) = (320, 160);
        let noisy: Vec<u8> = (0..width * height * 3).map(|i| ((i * 2_654_435_761_usize) >> 7) as u8 / 2).collect();
        for pixels in [noisy, gradient(width, height), vec![90; width * height * 3]] {
            for factor in [jpeg_encoder::SamplingFactor::F_1_1, jpeg_encoder::SamplingFactor::F_2_2] {
                for restart in [0, 7] {
                    let mut whole = Vec::new();
                    let mut encoder = jpeg_encoder::Encoder::new(&mut whole, 90);
                    encoder.set_sampling_factor(factor);
                    if restart > 0 {
                        encoder.set_restart_interval(restart);
                    }
                    encoder.encode(&pixels, width as u16, height as u16, jpeg_encoder::ColorType::Rgb).unwrap();
                    let mut expected = RgbImage::default();
                    decode_rgb(&whole, &mut expected).unwrap();
                    let mut image = RgbImage::default();
                    for padding in [vec![0; 10], vec![0xff; 3], vec![0x55; 1000], b"\xff\xd8 a preview".to_vec()] {
                        let padded = [&whole[..], &padding].concat();
                        assert_eq!(decode_rgb(&padded, &mut image), Ok(()));
                        assert!(image == expected);
                    }
                    // Without the marker all of the data are there.
                    assert_eq!(decode_rgb(&whole[..whole.len() - 2], &mut image), Ok(()));
                    assert!(image == expected);
                    let scan = Scan::of(&whole).unwrap();
                    let begin = (2..whole.len()).find(|&i| whole[i..].starts_with(&[0xff, 0xda])).unwrap() + 20;
                    for part in [0, 2, 5, 8] {
                        let cut = &whole[..begin + (scan.end - begin) * part / 10];
                        for marker in [&b""[..], b"\xff\xd9"] {
                            let cut = [cut, marker].concat();
                            assert!(
                                decode_rgb(&cut, &mut image).is_err(),
                                "{part} of 10, {marker:?}, restart {restart}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_progressive_picture_that_was_cut_is_damaged_wherever_it_was_cut() {
        let (width, height) = (320, 160);
        let noisy: Vec<u8> = (0..width * height * 3).map(|i| ((i * 2_654_435_761_usize) >> 7) as u8 / 2).collect();
        for pixels in [noisy, gradient(width, height), vec![90; width * height * 3]] {
            for (scans, restart) in [(2, 0), (4, 0), (10, 0), (4, 7)] {
                let mut whole = Vec::new();
                let mut encoder = jpeg_encoder::Encoder::new(&mut whole, 90);
                encoder.set_progressive_scans(scans);
                if restart > 0 {
                    encoder.set_restart_interval(restart);
                }
                encoder.encode(&pixels, width as u16, height as u16, jpeg_encoder::ColorType::Rgb).unwrap();
                let mut image = RgbImage::default();
                assert_eq!(decode_rgb(&whole, &mut image), Ok(()));
                assert_eq!((image.height, image.width), (height, width));
                assert_eq!(decode_rgb(&[&whole[..], &[0; 500]].concat(), &mut image), Ok(()));
                let begin = (2..whole.len()).find(|&i| whole[i..].starts_with(&[0xff, 0xda])).unwrap();
                let end = Scan::of(&whole).unwrap().end;
                // The last bytes of the last pass may be those of the last block.
                for at in (0..60).map(|part| begin + (end - begin) * part / 60) {
                    for marker in [&b""[..], b"\xff\xd9"] {
                        let cut = [&whole[..at], marker].concat();
                        assert!(
                            decode_rgb(&cut, &mut image).is_err(),
                            "{at} of {end} bytes, {scans} scans, {marker:?}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn pictures_are_turned_as_they_were_taken() {
        let pixels: Vec<u8> = (0..16 * 32).flat_map(|i| if i % 32 < 16 { [250, 0, 0] } else { [0, 0, 250] }).collect();
        let whole = jpeg(&pixels, 32, 16);
        // Orientation 6: the top of the scene is at the right of the sensor.
        let exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
        let length = (exif.len() as u16 + 2).to_be_bytes();
        let turned = [&whole[..2], &[0xff, 0xe1], &length, exif, &whole[2..]].concat();
        let mut image = RgbImage::default();
        decode_rgb(&turned, &mut image).unwrap();
        assert_eq!((image.height, image.width), (32, 16));
        assert_eq!(image_size(&turned), Ok([32, 16]));
        assert!(image.pixel(3, 8)[0] > 200 && image.pixel(28, 8)[2] > 200);
    }
}
