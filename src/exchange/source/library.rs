// == round_half_even
/// The nearest whole number of `x` in 0..255, of two equally near ones the even one.
fn round_half_even(x: f32) -> u8 {
    let whole = x as u8;
    let rest = x - f32::from(whole);
    if rest > 0.5 || (rest == 0.5 && whole % 2 == 1) { whole.saturating_add(1) } else { whole }
}

// == descale
/// `x / 2^bits`, rounded half up.
fn descale(x: i32, bits: u32) -> i32 {
    (x + (1 << (bits - 1))) >> bits
}

// == clamp_level
fn clamp_level(x: i32) -> u8 {
    x.clamp(0, 255) as u8
}

// == blur
/// The mean of 3x3 pixels of `[h][w][3]` with the weights 1, 2, 1 in each direction, rounded half up; mirrored at the border.
fn blur(src: &[u8], dst: &mut [u8], h: usize, w: usize) {
    let around = |i: usize, n: usize| {
        [if i > 0 { i - 1 } else { (n > 1) as usize }, i, i, if i + 1 < n { i + 1 } else { i.saturating_sub(1) }]
    };
    for (i, out) in dst[..h * w * 3].iter_mut().enumerate() {
        let (y, x, c) = (i / 3 / w, i / 3 % w, i % 3);
        let mut sum = 8;
        for y in around(y, h) {
            for x in around(x, w) {
                sum += u16::from(src[(y * w + x) * 3 + c]);
            }
        }
        *out = (sum / 16) as u8;
    }
}

// == resize
/// From `[from_h][from_w][channels]` to `[to_h][to_w][channels]`.
struct Resize {
    from_h: usize,
    from_w: usize,
    to_h: usize,
    to_w: usize,
    channels: usize,
}

// == resize_halve
/// The mean of each 2x2 block, rounded half up.
fn resize_halve(src: &[u8], dst: &mut [u8], s: Resize) {
    let row = s.from_w * s.channels;
    let pairs = src[..s.from_h * row].chunks_exact(2 * row);
    for (pair, out) in pairs.zip(dst[..s.to_h * s.to_w * s.channels].chunks_exact_mut(s.to_w * s.channels)) {
        for (i, out) in out.iter_mut().enumerate() {
            let block = i / s.channels * 2 * s.channels + i % s.channels;
            let levels = [block, block + s.channels, block + row, block + row + s.channels];
            *out = ((levels.iter().map(|&at| u16::from(pair[at])).sum::<u16>() + 2) / 4) as u8;
        }
    }
}

// == resize_linear
/// Between the nearest pixels. A tap is (low, high, weight of high); weights are in 2048ths.
fn resize_linear(src: &[u8], dst: &mut [u8], s: Resize, rows: &[u16], columns: &[u16]) {
    let src = &src[..s.from_h * s.from_w * s.channels];
    let out_rows = dst.chunks_exact_mut(s.to_w * s.channels).take(s.to_h);
    for (y, out) in rows.chunks_exact(3).zip(out_rows) {
        let row = |at: u16| &src[usize::from(at) * s.from_w * s.channels..][..s.from_w * s.channels];
        let (top, bottom, upper_y) = (row(y[0]), row(y[1]), i32::from(y[2]));
        for (x, out) in columns.chunks_exact(3).zip(out.chunks_exact_mut(s.channels)) {
            let (low, high, upper_x) = (usize::from(x[0]), usize::from(x[1]), i32::from(x[2]));
            for (c, out) in out.iter_mut().enumerate() {
                let (left, right) = (low * s.channels + c, high * s.channels + c);
                let blend = |row: &[u8]| i32::from(row[left]) * (2048 - upper_x) + i32::from(row[right]) * upper_x;
                let (above, below) = (blend(top) >> 4, blend(bottom) >> 4);
                *out = (((((2048 - upper_y) * above) >> 16) + ((upper_y * below) >> 16) + 2) >> 2) as u8;
            }
        }
    }
}

// == resize_area
/// The mean over the area that a pixel covers. A tap is (first position, first weight, end of the weights).
fn resize_area(
    src: &[u8],
    dst: &mut [u8],
    s: Resize,
    rows: &[u16],
    row_weights: &[f32],
    columns: &[u16],
    column_weights: &[f32],
) {
    let src = &src[..s.from_h * s.from_w * s.channels];
    let out_rows = dst.chunks_exact_mut(s.to_w * s.channels).take(s.to_h);
    for (y, out) in rows.chunks_exact(3).zip(out_rows) {
        let down = &row_weights[usize::from(y[1])..usize::from(y[2])];
        for (x, out) in columns.chunks_exact(3).zip(out.chunks_exact_mut(s.channels)) {
            let across = &column_weights[usize::from(x[1])..usize::from(x[2])];
            for (c, out) in out.iter_mut().enumerate() {
                let mut cell = 0.0;
                for (column, weight) in (usize::from(x[0])..).zip(across) {
                    let mut sum = 0.0;
                    for (row, weight) in (usize::from(y[0])..).zip(down) {
                        sum += f32::from(src[(row * s.from_w + column) * s.channels + c]) * weight;
                    }
                    cell += sum * weight;
                }
                *out = round_half_even(cell);
            }
        }
    }
}

// == to_planes
/// Converts each pixel of `[pixels][3]` and deals the result out to planes `[channels][pixels]`.
fn to_planes(rgb: &[u8], planes: &mut [u8], pixels: usize, channels: usize, convert: fn([u8; 3]) -> [u8; 3]) {
    for (i, pixel) in rgb[..3 * pixels].chunks_exact(3).enumerate() {
        let out = convert([pixel[0], pixel[1], pixel[2]]);
        for (c, level) in out.into_iter().enumerate().take(channels) {
            planes[c * pixels + i] = level;
        }
    }
}

// == rgb
fn rgb(pixel: [u8; 3]) -> [u8; 3] {
    pixel
}

// == bgr
fn bgr([r, g, b]: [u8; 3]) -> [u8; 3] {
    [b, g, r]
}

// == gray
/// Luminance with BT.601 weights, in the first place.
fn gray(pixel: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = pixel.map(i32::from);
    [descale(9798 * r + 19235 * g + 3735 * b, 15) as u8, 0, 0]
}

// == yuv
/// Y, U and V with BT.601 weights, U and V centred at 128.
fn yuv(pixel: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = pixel.map(i32::from);
    let y = descale(4899 * r + 9617 * g + 1868 * b, 14);
    let (u, v) = (descale(8061 * (b - y), 14) + 128, descale(14369 * (r - y), 14) + 128);
    [y as u8, clamp_level(u), clamp_level(v)]
}

// == yuv_old
/// The same with red and blue exchanged.
fn yuv_old([r, g, b]: [u8; 3]) -> [u8; 3] {
    yuv([b, g, r])
}

// == extremes
fn largest([r, g, b]: [u8; 3]) -> u8 {
    r.max(g).max(b)
}

fn smallest([r, g, b]: [u8; 3]) -> u8 {
    r.min(g).min(b)
}

// == saturation
/// Saturation of HSV, in the first place.
fn saturation(pixel: [u8; 3]) -> [u8; 3] {
    let value = largest(pixel);
    let spread = value - smallest(pixel);
    [descale(i32::from(spread) * HSV_SATURATION[usize::from(value)], 12) as u8, 0, 0]
}

// == hsv
/// Hue 0 to 179 in steps of two degrees, saturation, value.
fn hsv(pixel: [u8; 3]) -> [u8; 3] {
    let value = largest(pixel);
    let spread = value - smallest(pixel);
    let ([r, g, b], max, wide) = (pixel.map(i32::from), i32::from(value), i32::from(spread));
    let sector = if max == r {
        g - b
    } else if max == g {
        b - r + 2 * wide
    } else {
        r - g + 4 * wide
    };
    let hue = descale(sector * HSV_HUE[usize::from(spread)], 12);
    [clamp_level(if hue < 0 { hue + 180 } else { hue }), saturation(pixel)[0], value]
}

// == hls
/// Hue 0 to 179 in steps of two degrees, lightness, saturation.
fn hls(pixel: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = pixel.map(|x| f32::from(x) * (1.0 / 255.0));
    let [max, min] = [largest(pixel), smallest(pixel)].map(|x| f32::from(x) * (1.0 / 255.0));
    let (sum, spread) = (max + min, max - min);
    let lightness = sum * 0.5;
    let (mut hue_deg, mut saturation) = (0.0, 0.0);
    if spread > f32::EPSILON {
        saturation = if lightness < 0.5 { spread / sum } else { spread / (2.0 - max - min) };
        let step = 60.0 / spread;
        hue_deg = if max == r {
            (g - b) * step
        } else if max == g {
            (b - r) * step + 120.0
        } else {
            (r - g) * step + 240.0
        };
        if hue_deg < 0.0 {
            hue_deg += 360.0;
        }
    }
    [hue_deg * 0.5, lightness * 255.0, saturation * 255.0].map(round_half_even)
}

// == lab
/// CIE L*a*b* under D65; L scaled to 0 to 255, a and b centred at 128.
fn lab(pixel: [u8; 3]) -> [u8; 3] {
    let linear = pixel.map(|x| i32::from(LAB_LINEAR[usize::from(x)]));
    let f = [0, 3, 6].map(|row| {
        let light = (0..3).map(|c| linear[c] * i32::from(LAB_XYZ[row + c])).sum();
        i32::from(LAB_ROOT[descale(light, 12) as usize])
    });
    let l = descale(LAB_L_SCALE * f[1] + LAB_L_SHIFT, 15);
    let (a, b) = (descale(500 * (f[0] - f[1]), 15) + 128, descale(200 * (f[1] - f[2]), 15) + 128);
    [l, a, b].map(clamp_level)
}

// == to_input
/// Grey levels as the network takes them.
fn to_input(levels: &[u8], x: &mut [f32], n: usize, factor: f32, offset: f32) {
    for (x, level) in x[..n].iter_mut().zip(&levels[..n]) {
        *x = f32::from(*level) * factor + offset;
    }
}

// == conv2d
struct Conv {
    c: usize,
    h: usize,
    w: usize,
    filters: usize,
    kernel_h: usize,
    kernel_w: usize,
    stride_h: usize,
    stride_w: usize,
    pad_top: usize,
    pad_left: usize,
    out_h: usize,
    out_w: usize,
}

/// The output positions `i` whose input position `i * stride + tap - pad` lies in `0..size`.
fn inside(tap: usize, pad: usize, stride: usize, size: usize, out: usize) -> core::ops::Range<usize> {
    let first = pad.saturating_sub(tap).div_ceil(stride);
    let end = (size + pad).saturating_sub(tap).div_ceil(stride);
    first..end.min(out)
}

/// Convolution with zeros beyond the border: `[c][h][w]` to `[filters][out_h][out_w]`, weights
/// `[filters][c][kernel_h][kernel_w]`.
fn conv2d(x: &[f32], y: &mut [f32], weight: &[f32], bias: &[f32], s: Conv) {
    let taps = s.c * s.kernel_h * s.kernel_w;
    let maps = y.chunks_exact_mut(s.out_h * s.out_w).take(s.filters);
    for ((map, weight), bias) in maps.zip(weight.chunks_exact(taps)).zip(bias) {
        map.fill(*bias);
        for (tap, weight) in weight.iter().enumerate() {
            let (c, k, l) = (tap / (s.kernel_h * s.kernel_w), tap / s.kernel_w % s.kernel_h, tap % s.kernel_w);
            let columns = inside(l, s.pad_left, s.stride_w, s.w, s.out_w);
            if columns.is_empty() {
                continue;
            }
            for i in inside(k, s.pad_top, s.stride_h, s.h, s.out_h) {
                let row = &x[(c * s.h + i * s.stride_h + k - s.pad_top) * s.w..][..s.w];
                let out = &mut map[i * s.out_w..][columns.clone()];
                let inputs = &row[columns.start * s.stride_w + l - s.pad_left..];
                if s.stride_w == 1 {
                    for (out, x) in out.iter_mut().zip(inputs) {
                        *out += weight * x;
                    }
                } else {
                    for (out, x) in out.iter_mut().zip(inputs.iter().step_by(s.stride_w)) {
                        *out += weight * x;
                    }
                }
            }
        }
    }
}

// == depthwise
/// The convolution of each channel alone, weights `[c][kernel_h][kernel_w]`.
fn depthwise(x: &[f32], y: &mut [f32], weight: &[f32], bias: &[f32], s: Conv) {
    let maps = x.chunks_exact(s.h * s.w).zip(y.chunks_exact_mut(s.out_h * s.out_w));
    let kernels = weight.chunks_exact(s.kernel_h * s.kernel_w).zip(bias);
    for ((x, y), (kernel, bias)) in maps.zip(kernels) {
        conv2d(x, y, kernel, core::slice::from_ref(bias), Conv { c: 1, filters: 1, ..s });
    }
}

// == dense
/// `[inputs]` to `[units]`, weights `[units][inputs]`.
fn dense(x: &[f32], y: &mut [f32], weight: &[f32], bias: &[f32], inputs: usize, units: usize) {
    for ((y, row), bias) in y[..units].iter_mut().zip(weight.chunks_exact(inputs)).zip(bias) {
        *y = row.iter().zip(x).fold(*bias, |sum, (w, x)| sum + w * x);
    }
}

// == pool
struct Pool {
    c: usize,
    h: usize,
    w: usize,
    window_h: usize,
    window_w: usize,
    stride_h: usize,
    stride_w: usize,
    out_h: usize,
    out_w: usize,
}

/// Reduces each window to one number.
fn pool(x: &[f32], y: &mut [f32], s: &Pool, first: f32, reduce: impl Fn(f32, f32) -> f32) {
    for (row, out) in y.chunks_exact_mut(s.out_w).enumerate().take(s.c * s.out_h) {
        let top = row / s.out_h * s.h + row % s.out_h * s.stride_h;
        for (j, out) in out.iter_mut().enumerate() {
            let rows = x[top * s.w..].chunks_exact(s.w).take(s.window_h);
            *out = rows.flat_map(|row| &row[j * s.stride_w..][..s.window_w]).fold(first, |a, b| reduce(a, *b));
        }
    }
}

// == max_pool
/// The largest number of each window.
fn max_pool(x: &[f32], y: &mut [f32], s: Pool) {
    pool(x, y, &s, f32::NEG_INFINITY, f32::max);
}

// == average_pool
/// The mean of each window.
fn average_pool(x: &[f32], y: &mut [f32], s: Pool) {
    pool(x, y, &s, 0.0, |a, b| a + b);
    let size = (s.window_h * s.window_w) as f32;
    y[..s.c * s.out_h * s.out_w].iter_mut().for_each(|y| *y /= size);
}

// == crop
struct Crop {
    c: usize,
    h: usize,
    w: usize,
    top: usize,
    left: usize,
    out_h: usize,
    out_w: usize,
}

/// The window of each map that begins at (`top`, `left`).
fn crop(x: &[f32], y: &mut [f32], s: Crop) {
    for (row, out) in y.chunks_exact_mut(s.out_w).enumerate().take(s.c * s.out_h) {
        let start = (row / s.out_h * s.h + s.top + row % s.out_h) * s.w + s.left;
        out.copy_from_slice(&x[start..][..s.out_w]);
    }
}

// == zero_pad
struct Pad {
    c: usize,
    h: usize,
    w: usize,
    top: usize,
    left: usize,
    out_h: usize,
    out_w: usize,
}

/// Each map from (`top`, `left`) on, with zeros around.
fn zero_pad(x: &[f32], y: &mut [f32], s: Pad) {
    y[..s.c * s.out_h * s.out_w].fill(0.0);
    for (row, x) in x.chunks_exact(s.w).enumerate().take(s.c * s.h) {
        let start = (row / s.h * s.out_h + s.top + row % s.h) * s.out_w + s.left;
        y[start..][..s.w].copy_from_slice(x);
    }
}

// == resample_map
struct Resample {
    c: usize,
    h: usize,
    w: usize,
    out_h: usize,
    out_w: usize,
}

/// Weighted sums of rows and columns of each map. A tap is (first position, first weight, end of the weights).
fn resample_map(
    x: &[f32],
    y: &mut [f32],
    rows: &[i32],
    row_weights: &[f32],
    columns: &[i32],
    column_weights: &[f32],
    s: Resample,
) {
    let places = y[..s.c * s.out_h * s.out_w].iter_mut().enumerate();
    for (place, out) in places {
        let (c, i, j) = (place / s.out_w / s.out_h, place / s.out_w % s.out_h, place % s.out_w);
        let [y, x_tap] = [&rows[3 * i..], &columns[3 * j..]].map(|tap| [tap[0] as usize, tap[1] as usize, tap[2] as usize]);
        *out = 0.0;
        for (l, across) in column_weights[x_tap[1]..x_tap[2]].iter().enumerate() {
            let mut sum = 0.0;
            for (k, down) in row_weights[y[1]..y[2]].iter().enumerate() {
                sum += down * x[(c * s.h + y[0] + k) * s.w + x_tap[0] + l];
            }
            *out += across * sum;
        }
    }
}

// == scale_channels
/// Batch normalisation: a factor and an offset for each channel.
fn scale_channels(x: &mut [f32], factor: &[f32], offset: &[f32], positions: usize) {
    for ((channel, factor), offset) in x.chunks_exact_mut(positions).zip(factor).zip(offset) {
        channel.iter_mut().for_each(|x| *x = *x * factor + offset);
    }
}

// == relu
fn relu(x: f32) -> f32 {
    if x > 0.0 { x } else { 0.0 }
}

// == prelu
/// Each slope serves `repeat` numbers.
fn prelu(x: &mut [f32], slope: &[f32], repeat: usize) {
    for (x, slope) in x.chunks_exact_mut(repeat).zip(slope) {
        x.iter_mut().for_each(|x| *x = if *x > 0.0 { *x } else { slope * *x });
    }
}

// == exp
/// `e^x - 1` for `x <= 0`, relative error below 1e-6: `x = k ln 2 + r`, and the series of `e^r - 1`.
fn expm1_of_negative(x: f32) -> f32 {
    let x = if x > -50.0 { x } else { -50.0 };
    let k = (x * core::f32::consts::LOG2_E - 0.5) as i32;
    let r = (x - k as f32 * 0.693_359_4) - k as f32 * -2.121_944_4e-4;
    let tail = 1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r * (1.0 / 5040.0)));
    let series = r + r * r * (0.5 + r * (1.0 / 6.0 + r * tail));
    let power = f32::from_bits(((k + 127) as u32) << 23);
    power * series + (power - 1.0)
}

// == elu
fn elu(x: f32, alpha: f32) -> f32 {
    if x > 0.0 { x } else { alpha * expm1_of_negative(x) }
}

// == hyperbolic_tangent
fn hyperbolic_tangent(x: f32) -> f32 {
    let e = expm1_of_negative(if x > 0.0 { -2.0 * x } else { 2.0 * x });
    let size = -e / (e + 2.0);
    if x > 0.0 { size } else { -size }
}

// == leaky_relu
fn leaky_relu(x: f32, slope: f32) -> f32 {
    if x > 0.0 { x } else { slope * x }
}

// == softsign
fn softsign(x: f32) -> f32 {
    x / (1.0 + if x > 0.0 { x } else { -x })
}

// == sigmoid
/// `1 / (1 + e^-x)`, from `e^-|x|`.
fn sigmoid(x: f32) -> f32 {
    let e = expm1_of_negative(if x > 0.0 { -x } else { x });
    if x > 0.0 { 1.0 / (e + 2.0) } else { (e + 1.0) / (e + 2.0) }
}
