use super::jpeg::Scan;
use super::png::without_metadata;
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
    image::codecs::png::PngEncoder::new(&mut png).write_image(&pixels, 40, 24, image::ExtendedColorType::Rgb8).unwrap();
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
                        assert!(decode_rgb(&cut, &mut image).is_err(), "{part} of 10, {marker:?}, restart {restart}");
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
                    assert!(decode_rgb(&cut, &mut image).is_err(), "{at} of {end} bytes, {scans} scans, {marker:?}");
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
