//! The sizes of a convolution.

/// The sizes of a two-dimensional convolution (cross-correlation, as in every framework) of one image.
///
/// `x`: `[c][h][w]`, weight: `[oc][c][kh][kw]`, `y`: `[oc][out_h][out_w]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// Input channels.
    pub c: usize,
    /// Input height.
    pub h: usize,
    /// Input width.
    pub w: usize,
    /// Output channels.
    pub oc: usize,
    /// Kernel height, at least 1.
    pub kh: usize,
    /// Kernel width, at least 1.
    pub kw: usize,
    /// Rows between windows, at least 1.
    pub stride_h: usize,
    /// Columns between windows, at least 1.
    pub stride_w: usize,
    /// Rows of zeros above the image.
    pub pad_top: usize,
    /// Rows of zeros below the image.
    pub pad_bottom: usize,
    /// Columns of zeros left of the image.
    pub pad_left: usize,
    /// Columns of zeros right of the image.
    pub pad_right: usize,
}

impl ConvShape {
    /// Output height, 0 if the kernel is higher than the padded image.
    pub fn out_h(&self) -> usize {
        let padded = self.h + self.pad_top + self.pad_bottom;
        if padded < self.kh { 0 } else { (padded - self.kh) / self.stride_h + 1 }
    }

    /// Output width, 0 if the kernel is wider than the padded image.
    pub fn out_w(&self) -> usize {
        let padded = self.w + self.pad_left + self.pad_right;
        if padded < self.kw { 0 } else { (padded - self.kw) / self.stride_w + 1 }
    }

    /// Multiply-adds of the forward pass of one image; each gradient takes as many.
    pub fn multiply_adds(&self) -> u64 {
        (self.out_h() * self.out_w() * self.oc) as u64 * self.taps() as u64
    }

    /// Elements of one input image, `c * h * w`.
    pub fn x_len(&self) -> usize {
        self.c * self.h * self.w
    }

    /// Elements of one output image, `oc * out_h * out_w`.
    pub fn y_len(&self) -> usize {
        self.oc * self.out_pixels()
    }

    /// Elements of one output channel, `out_h * out_w`.
    pub fn out_pixels(&self) -> usize {
        self.out_h() * self.out_w()
    }

    /// Weights of one output channel, `c * kh * kw`.
    pub fn taps(&self) -> usize {
        self.c * self.kh * self.kw
    }

    /// Whether any zeros surround the image.
    pub fn is_padded(&self) -> bool {
        self.pad_top + self.pad_bottom + self.pad_left + self.pad_right > 0
    }
}
