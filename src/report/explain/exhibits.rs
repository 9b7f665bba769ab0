//! The pictures of an explanation: saliency, filters, feature maps, and one picture in all its changes.

use super::change::Change;
use super::footage::{Footage, FootageBuffers};
use super::saliency::Saliency;
use crate::engine::layers::{Family, ReceptiveField};
use crate::engine::network::NamedLayer;
use crate::error::Result;
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::charts::palette::{MODEL_RGB, REFERENCE_RGB};
use crate::report::charts::steering_line::draw_steering;

/// Pictures with saliency.
const SALIENT: usize = 12;
/// Gap between tiles, pixels.
const GAP: usize = 3;
/// Width that a sheet of tiles is filled to.
const SHEET: usize = 1100;

/// A picture of the explanation.
pub struct Exhibit {
    /// File name without folder and ending.
    pub name: String,
    /// The picture.
    pub picture: RgbImage,
    /// What it shows.
    pub caption: String,
}

/// All pictures of an explanation.
pub struct Exhibits {
    /// Camera pictures with saliency.
    pub saliency: Vec<Exhibit>,
    /// Filters of the first convolution.
    pub filters: Option<Exhibit>,
    /// Feature maps of each convolution for one picture.
    pub features: Vec<Exhibit>,
    /// That picture in all its changes.
    pub changes: Vec<Exhibit>,
}

/// Makes the pictures. `steering` is what the model says of each picture of `footage`.
///
/// # Errors
///
/// As [`Saliency::new`] and [`Footage::picture`].
pub fn exhibits(pilot: &Pilot, footage: &Footage, steering: &[f32]) -> Result<Exhibits> {
    let (mut pilot, mut buffers, mut image) = (pilot.clone(), FootageBuffers::default(), RgbImage::default());
    let mut saliency = Saliency::new(pilot.network())?;
    let full_lock_deg = pilot.recipe().full_lock_deg;
    let degrees = |steering: f32| f64::from(steering) * full_lock_deg;
    // From hard left to hard right, as the model sees it.
    let mut order: Vec<usize> = (0..footage.len()).collect();
    order.sort_by(|&a, &b| steering[a].total_cmp(&steering[b]));
    let count = SALIENT.min(order.len());
    let place = |i: usize| if count == 1 { 0.5 } else { i as f64 / (count - 1) as f64 };
    let chosen: Vec<usize> =
        (0..count).map(|i| order[((order.len() - 1) as f64 * place(i)).round() as usize]).collect();
    let mut salient = Vec::new();
    for (k, &i) in chosen.iter().enumerate() {
        footage.picture(i, &mut buffers, &mut image)?;
        let answer = saliency.steer(&mut pilot, image.view())?;
        let mut picture = image.clone();
        saliency.overlay(&pilot.recipe().preprocessing, &mut picture);
        let mut caption = format!("{}\nmodel {:+.1}°", footage.name(i), degrees(answer));
        if let Some(label) = footage.label(i) {
            draw_steering(&mut picture, degrees(label), REFERENCE_RGB);
            caption += &format!(", label {:+.1}°", degrees(label));
        }
        draw_steering(&mut picture, degrees(answer), MODEL_RGB);
        salient.push(Exhibit { name: format!("saliency_{:02}", k + 1), picture, caption });
    }
    // The hardest steering shows most.
    let hardest = (0..footage.len()).max_by(|&a, &b| steering[a].abs().total_cmp(&steering[b].abs())).unwrap_or(0);
    footage.picture(hardest, &mut buffers, &mut image)?;
    let features = features(&mut pilot, &image)?;
    let mut changes = vec![Exhibit {
        name: "change_none".into(),
        caption: format!("{}, unchanged: {:+.1}°", footage.name(hardest), degrees(steering[hardest])),
        picture: image.clone(),
    }];
    for (k, change) in Change::ALL.into_iter().enumerate() {
        let mut picture = RgbImage::default();
        change.apply(&image, &mut picture);
        let answer = pilot.steer(picture.view())?;
        let caption = format!("{}: {:+.1}°", change.text(), degrees(answer));
        changes.push(Exhibit { name: format!("change_{:02}", k + 1), picture, caption });
    }
    Ok(Exhibits { saliency: salient, filters: filters(&pilot), features, changes })
}

/// The filters of the first convolution; with three input planes, as colours. `None` without a convolution.
fn filters(pilot: &Pilot) -> Option<Exhibit> {
    let network = pilot.network();
    let layer = network.layers().iter().find(|layer| layer.spec.family() == Family::Convolution)?;
    let tensor = network.tensors().iter().find(|tensor| tensor.name == format!("{}.weight", layer.name))?;
    let weights = pilot.parameters().tensor(tensor);
    let [oc, c, kh, kw] = tensor.spec.shape[..] else { return None };
    let most = weights.iter().fold(1e-9f32, |most, weight| most.max(weight.abs()));
    let level = |o: usize, plane: usize, k: usize, l: usize| {
        (127.5 + 127.5 * weights[((o * c + plane) * kh + k) * kw + l] / most).round() as u8
    };
    let tiles: Vec<RgbImage> = (0..oc)
        .map(|o| {
            let planes = if c == 3 { [0, 1, 2] } else { [0, 0, 0] };
            RgbImage::from_fn(kh, kw, |k, l| planes.map(|plane| level(o, plane, k, l)))
                .enlarged((64 / kh.max(kw)).max(1))
        })
        .collect();
    let planes = pilot.recipe().preprocessing.colour.plane_names().join(", ");
    let shown = if c == 3 { "drawn as red, green, blue" } else { "the first plane, in grey" };
    let caption = format!(
        "{}: {oc} filters of {kh}x{kw} on {planes}, {shown}; middle grey is 0, the largest weight {most:.3}",
        layer.name
    );
    Some(Exhibit { name: "filters".into(), picture: sheet(&tiles), caption })
}

/// The feature maps of each convolution, after its activation.
fn features(pilot: &mut Pilot, image: &RgbImage) -> Result<Vec<Exhibit>> {
    let mut seen: Vec<(usize, Vec<f32>)> = Vec::new();
    pilot.steer_observed(image.view(), &mut |layer, output| seen.push((layer, output.to_vec())))?;
    let layers = pilot.network().layers();
    let mut exhibits = Vec::new();
    for (index, layer) in layers.iter().enumerate() {
        if layer.spec.family() != Family::Convolution {
            continue;
        }
        // As the maps leave the activation: after the layers behind the convolution that see each value alone.
        let keeps_maps =
            |layer: &&NamedLayer| layer.spec.receptive_field(layer.layer.input()) == ReceptiveField::Element;
        let after = layers[index + 1..].iter().take_while(keeps_maps).count();
        let Some((_, maps)) = seen.iter().find(|(at, _)| *at == index + after) else { continue };
        let shape = layer.layer.output();
        let tiles: Vec<RgbImage> =
            maps.chunks_exact(shape.positions()).map(|map| map_tile(map, shape.h, shape.w)).collect();
        let caption = format!(
            "{}: {} maps of {}x{}, each from its smallest (black) to its largest value (white)",
            layer.name, shape.c, shape.h, shape.w
        );
        exhibits.push(Exhibit { name: format!("features_{}", layer.name), picture: sheet(&tiles), caption });
    }
    Ok(exhibits)
}

/// A feature map in grey, enlarged to be seen.
fn map_tile(map: &[f32], height: usize, width: usize) -> RgbImage {
    let (low, high) = map.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
    let range = (high - low).max(1e-12);
    let levels: Vec<u8> = map.iter().map(|value| (255.0 * (value - low) / range).round() as u8).collect();
    RgbImage::grey(height, width, &levels).enlarged((132 / width.max(2 * height)).max(1))
}

/// Tiles of one size in rows.
fn sheet(tiles: &[RgbImage]) -> RgbImage {
    let Some(first) = tiles.first() else { return RgbImage::default() };
    let across = (SHEET / (first.width + GAP)).clamp(1, tiles.len());
    let down = tiles.len().div_ceil(across);
    let size = |count: usize, extent: usize| count * (extent + GAP) - GAP;
    let mut sheet = RgbImage::filled(size(down, first.height), size(across, first.width), [255; 3]);
    for (i, tile) in tiles.iter().enumerate() {
        sheet.paste(tile, i / across * (first.height + GAP), i % across * (first.width + GAP));
    }
    sheet
}
