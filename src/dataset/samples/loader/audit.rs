//! The audit of near twins: of the pictures that are decoded, what it compares is kept.

use super::Loader;
use crate::dataset::pictures::preprocess::Preprocessing;
use crate::dataset::recording::View;
use crate::dataset::samples::leak::{NearTwins, Thumbnail};
use crate::picture::RgbImage;
use rayon::prelude::*;
use std::sync::OnceLock;

/// Thumbnails are sent in pieces hardly longer than this.
const PIECE_BYTES: usize = 1 << 20;

impl Loader {
    /// How many frames of this (validation) loader have a near twin in `training`. Frames are known once they, or those of the other
    /// cameras beside them, were shown, so this is to be asked after the first epoch.
    pub fn near_twins(&self, training: &Loader) -> NearTwins {
        training.look_at_centres();
        let one_row_in = [self, training].map(|side| side.compared_every);
        NearTwins::count(&self.thumbnails_kept(), &training.thumbnails_kept(), one_row_in)
    }

    fn thumbnails_kept(&self) -> Vec<&Thumbnail> {
        self.thumbnails.iter().filter_map(OnceLock::get).flatten().collect()
    }

    /// Whether the audit of near twins looks at the row of this image. Of a row that counts several times its first item decides,
    /// whichever is decoded first.
    pub(super) fn is_compared(&self, image: u32) -> bool {
        let item = self.images[image as usize].0 as usize;
        let before = self.items[..item].iter().rev().take_while(|other| **other == self.items[item]).count();
        (item - before).is_multiple_of(self.compared_every)
    }

    pub(super) fn thumbnail(&self, decoded: &RgbImage) -> Thumbnail {
        let Preprocessing { rows, source, .. } = self.spec.preprocessing;
        Thumbnail::of(decoded, rows, source[0])
    }

    /// Looks at the centre pictures of rows of which only other pictures were shown: a view from beside the path is made of the nearest
    /// camera's.
    fn look_at_centres(&self) {
        let known = |image: u32| self.thumbnails[self.pictures[image as usize] as usize].get().is_some();
        (0..self.items.len()).into_par_iter().for_each_init(
            Default::default,
            |(file, decoded): &mut (_, RgbImage), item| {
                let images = self.first_images[item]..self.first_images[item + 1];
                let centre = images.clone().find(|&image| self.images[image as usize].1 == View::Centre);
                let Some(centre) =
                    centre.filter(|&centre| self.is_compared(centre) && !known(centre) && images.clone().any(known))
                else {
                    return;
                };
                // Pictures that cannot be read are told where they are trained on.
                if self.read(centre, file, decoded).is_ok() {
                    let _ = self.thumbnails[self.pictures[centre as usize] as usize].set(Some(self.thumbnail(decoded)));
                }
            },
        );
    }

    /// Gives `piece` all that the audit of near twins knows of the pictures that were decoded so far, in pieces for
    /// [`take_thumbnails`](Loader::take_thumbnails).
    pub fn thumbnails(&self, mut piece: impl FnMut(&[u8])) {
        let known =
            self.thumbnails.iter().enumerate().filter_map(|(picture, thumbnail)| Some((picture, thumbnail.get()?)));
        let mut bytes = Vec::new();
        for (picture, thumbnail) in known {
            if bytes.len() > PIECE_BYTES {
                piece(&bytes);
                bytes.clear();
            }
            bytes.extend((picture as u32).to_le_bytes());
            bytes.push(u8::from(thumbnail.is_some()));
            bytes.extend(thumbnail.iter().flat_map(|thumbnail| thumbnail.cells()));
        }
        if !bytes.is_empty() {
            piece(&bytes);
        }
    }

    /// Takes over what another process knows of the same pictures.
    pub fn take_thumbnails(&self, mut bytes: &[u8]) {
        while let Some((head, rest)) = bytes.split_at_checked(5) {
            let picture = u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize;
            let len = if head[4] == 0 { 0 } else { Thumbnail::LEN };
            let Some((cells, rest)) = rest.split_at_checked(len) else { return };
            bytes = rest;
            let thumbnail = Thumbnail::of_cells(cells);
            if let Some(known) = self.thumbnails.get(picture) {
                known.get_or_init(|| thumbnail);
            }
        }
    }
}
