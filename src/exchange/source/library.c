/* == round_half_even */
/* The nearest whole number of x in 0..255, of two equally near ones the even one. */
static uint8_t round_half_even(float x) {
    int whole = (int)x;
    float rest = x - (float)whole;
    if (rest > 0.5f || (rest == 0.5f && whole % 2 == 1)) {
        whole++;
    }
    return (uint8_t)(whole > 255 ? 255 : whole);
}

/* == descale */
/* x / 2^bits, rounded half up. */
static int32_t descale(int32_t x, int bits) {
    int32_t divisor = (int32_t)1 << bits;
    int32_t numerator = x + divisor / 2;
    int32_t quotient = numerator / divisor;
    return numerator % divisor < 0 ? quotient - 1 : quotient;
}

/* == clamp_level */
static uint8_t clamp_level(int32_t x) {
    return (uint8_t)(x < 0 ? 0 : x > 255 ? 255 : x);
}

/* == blur */
/* The mean of 3x3 pixels of [h][w][3] with the weights 1, 2, 1 in each direction, rounded half up; mirrored at the border. */
static void blur(const uint8_t *src, uint8_t *dst, int h, int w) {
    for (int y = 0; y < h; y++) {
        int rows[4] = {y > 0 ? y - 1 : h > 1, y, y, y + 1 < h ? y + 1 : y > 0 ? y - 1 : 0};
        for (int x = 0; x < w; x++) {
            int columns[4] = {x > 0 ? x - 1 : w > 1, x, x, x + 1 < w ? x + 1 : x > 0 ? x - 1 : 0};
            for (int c = 0; c < 3; c++) {
                int sum = 8;
                for (int i = 0; i < 4; i++) {
                    for (int j = 0; j < 4; j++) {
                        sum += src[(rows[i] * w + columns[j]) * 3 + c];
                    }
                }
                *dst++ = (uint8_t)(sum / 16);
            }
        }
    }
}

/* == resize */
/* From [from_h][from_w][channels] to [to_h][to_w][channels]. */
struct resize {
    int from_h, from_w, to_h, to_w, channels;
};

/* == resize_halve */
/* The mean of each 2x2 block, rounded half up. */
static void resize_halve(const uint8_t *src, uint8_t *dst, struct resize s) {
    int row = s.from_w * s.channels;
    for (int i = 0; i < s.to_h; i++) {
        for (int j = 0; j < s.to_w; j++) {
            for (int c = 0; c < s.channels; c++) {
                const uint8_t *block = src + 2 * i * row + 2 * j * s.channels + c;
                int sum = block[0] + block[s.channels] + block[row] + block[row + s.channels];
                *dst++ = (uint8_t)((sum + 2) / 4);
            }
        }
    }
}

/* == resize_linear */
/* Between the nearest pixels. A tap is (low, high, weight of high); weights are in 2048ths. */
static void resize_linear(const uint8_t *src, uint8_t *dst, struct resize s, const uint16_t *rows, const uint16_t *columns) {
    for (int i = 0; i < s.to_h; i++) {
        const uint16_t *y = rows + 3 * i;
        const uint8_t *top = src + y[0] * s.from_w * s.channels;
        const uint8_t *bottom = src + y[1] * s.from_w * s.channels;
        for (int j = 0; j < s.to_w; j++) {
            const uint16_t *x = columns + 3 * j;
            for (int c = 0; c < s.channels; c++) {
                int left = x[0] * s.channels + c, right = x[1] * s.channels + c;
                int32_t above = (int32_t)top[left] * (2048 - x[2]) + (int32_t)top[right] * x[2];
                int32_t below = (int32_t)bottom[left] * (2048 - x[2]) + (int32_t)bottom[right] * x[2];
                int32_t level = (2048 - y[2]) * (above / 16) / 65536 + y[2] * (below / 16) / 65536;
                *dst++ = (uint8_t)((level + 2) / 4);
            }
        }
    }
}

/* == resize_area */
/* The mean over the area that a pixel covers. A tap is (first position, first weight, end of the weights). */
static void resize_area(const uint8_t *src, uint8_t *dst, struct resize s, const uint16_t *rows, const float *row_weights,
                        const uint16_t *columns, const float *column_weights) {
    for (int i = 0; i < s.to_h; i++) {
        const uint16_t *y = rows + 3 * i;
        for (int j = 0; j < s.to_w; j++) {
            const uint16_t *x = columns + 3 * j;
            for (int c = 0; c < s.channels; c++) {
                float cell = 0.0f;
                for (int l = x[1]; l < x[2]; l++) {
                    int column = x[0] + l - x[1];
                    float sum = 0.0f;
                    for (int k = y[1]; k < y[2]; k++) {
                        int row = y[0] + k - y[1];
                        sum += (float)src[(row * s.from_w + column) * s.channels + c] * row_weights[k];
                    }
                    cell += sum * column_weights[l];
                }
                *dst++ = round_half_even(cell);
            }
        }
    }
}

/* == to_planes */
/* Converts each pixel of [pixels][3] and deals the result out to planes [channels][pixels]. */
static void to_planes(const uint8_t *rgb, uint8_t *planes, int pixels, int channels,
                      void (*convert)(const uint8_t *pixel, uint8_t *out)) {
    for (int i = 0; i < pixels; i++) {
        uint8_t out[3];
        convert(rgb + 3 * i, out);
        for (int c = 0; c < channels; c++) {
            planes[c * pixels + i] = out[c];
        }
    }
}

/* == rgb */
static void rgb(const uint8_t *pixel, uint8_t *out) {
    out[0] = pixel[0];
    out[1] = pixel[1];
    out[2] = pixel[2];
}

/* == bgr */
static void bgr(const uint8_t *pixel, uint8_t *out) {
    out[0] = pixel[2];
    out[1] = pixel[1];
    out[2] = pixel[0];
}

/* == gray */
/* Luminance with BT.601 weights. */
static void gray(const uint8_t *pixel, uint8_t *out) {
    out[0] = (uint8_t)descale(9798 * (int32_t)pixel[0] + 19235 * (int32_t)pixel[1] + 3735 * (int32_t)pixel[2], 15);
}

/* == yuv */
/* Y, U and V with BT.601 weights, U and V centred at 128. */
static void yuv(const uint8_t *pixel, uint8_t *out) {
    int32_t r = pixel[0], g = pixel[1], b = pixel[2];
    int32_t y = descale(4899 * r + 9617 * g + 1868 * b, 14);
    out[0] = (uint8_t)y;
    out[1] = clamp_level(descale(8061 * (b - y), 14) + 128);
    out[2] = clamp_level(descale(14369 * (r - y), 14) + 128);
}

/* == yuv_old */
/* The same with red and blue exchanged. */
static void yuv_old(const uint8_t *pixel, uint8_t *out) {
    const uint8_t bgr[3] = {pixel[2], pixel[1], pixel[0]};
    yuv(bgr, out);
}

/* == extremes */
static uint8_t largest(const uint8_t *pixel) {
    uint8_t pair = pixel[0] > pixel[1] ? pixel[0] : pixel[1];
    return pair > pixel[2] ? pair : pixel[2];
}

static uint8_t smallest(const uint8_t *pixel) {
    uint8_t pair = pixel[0] < pixel[1] ? pixel[0] : pixel[1];
    return pair < pixel[2] ? pair : pixel[2];
}

/* == saturation */
/* Saturation of HSV. */
static void saturation(const uint8_t *pixel, uint8_t *out) {
    uint8_t value = largest(pixel);
    out[0] = (uint8_t)descale((value - smallest(pixel)) * hsv_saturation[value], 12);
}

/* == hsv */
/* Hue 0 to 179 in steps of two degrees, saturation, value. */
static void hsv(const uint8_t *pixel, uint8_t *out) {
    int32_t r = pixel[0], g = pixel[1], b = pixel[2];
    int32_t value = largest(pixel), spread = value - smallest(pixel);
    int32_t sector = value == r ? g - b : value == g ? b - r + 2 * spread : r - g + 4 * spread;
    int32_t hue = descale(sector * hsv_hue[spread], 12);
    out[0] = clamp_level(hue < 0 ? hue + 180 : hue);
    saturation(pixel, out + 1);
    out[2] = (uint8_t)value;
}

/* == hls */
/* Hue 0 to 179 in steps of two degrees, lightness, saturation. */
static void hls(const uint8_t *pixel, uint8_t *out) {
    float r = (float)pixel[0] * (1.0f / 255.0f), g = (float)pixel[1] * (1.0f / 255.0f), b = (float)pixel[2] * (1.0f / 255.0f);
    float max = (float)largest(pixel) * (1.0f / 255.0f), min = (float)smallest(pixel) * (1.0f / 255.0f);
    float sum = max + min, spread = max - min, lightness = sum * 0.5f;
    float hue_deg = 0.0f, saturation = 0.0f;
    if (spread > 1.1920929e-7f) {
        float step = 60.0f / spread;
        saturation = lightness < 0.5f ? spread / sum : spread / (2.0f - max - min);
        hue_deg = max == r ? (g - b) * step : max == g ? (b - r) * step + 120.0f : (r - g) * step + 240.0f;
        if (hue_deg < 0.0f) {
            hue_deg += 360.0f;
        }
    }
    out[0] = round_half_even(hue_deg * 0.5f);
    out[1] = round_half_even(lightness * 255.0f);
    out[2] = round_half_even(saturation * 255.0f);
}

/* == lab */
/* CIE L*a*b* under D65; L scaled to 0 to 255, a and b centred at 128. */
static void lab(const uint8_t *pixel, uint8_t *out) {
    int32_t f[3];
    for (int i = 0; i < 3; i++) {
        int32_t light = 0;
        for (int c = 0; c < 3; c++) {
            light += lab_linear[pixel[c]] * (int32_t)lab_xyz[3 * i + c];
        }
        f[i] = lab_root[descale(light, 12)];
    }
    out[0] = clamp_level(descale(LAB_L_SCALE * f[1] + LAB_L_SHIFT, 15));
    out[1] = clamp_level(descale(500 * (f[0] - f[1]), 15) + 128);
    out[2] = clamp_level(descale(200 * (f[1] - f[2]), 15) + 128);
}

/* == to_input */
/* Grey levels as the network takes them. */
static void to_input(const uint8_t *levels, float *x, int n, float factor, float offset) {
    for (int i = 0; i < n; i++) {
        x[i] = (float)levels[i] * factor + offset;
    }
}

/* == conv2d */
struct conv {
    int c, h, w, filters, kernel_h, kernel_w, stride_h, stride_w, pad_top, pad_left, out_h, out_w;
};

/* The first output position i whose input position i * stride + offset is not before the border. */
static int first_inside(int offset, int stride) {
    return offset < 0 ? (stride - 1 - offset) / stride : 0;
}

/* The first one after that whose input position lies beyond size, at most out. */
static int end_inside(int offset, int stride, int size, int out) {
    int end = size > offset ? (size - offset + stride - 1) / stride : 0;
    return end < out ? end : out;
}

/* Convolution with zeros beyond the border: [c][h][w] to [filters][out_h][out_w], weights [filters][c][kernel_h][kernel_w]. */
static void conv2d(const float *x, float *y, const float *weight, const float *bias, struct conv s) {
    for (int o = 0; o < s.filters; o++) {
        float *map = y + o * s.out_h * s.out_w;
        for (int i = 0; i < s.out_h * s.out_w; i++) {
            map[i] = bias[o];
        }
        for (int tap = 0; tap < s.c * s.kernel_h * s.kernel_w; tap++) {
            float w = *weight++;
            int c = tap / (s.kernel_h * s.kernel_w);
            int top = tap / s.kernel_w % s.kernel_h - s.pad_top, left = tap % s.kernel_w - s.pad_left;
            int from = first_inside(left, s.stride_w), to = end_inside(left, s.stride_w, s.w, s.out_w);
            int end = end_inside(top, s.stride_h, s.h, s.out_h);
            for (int i = first_inside(top, s.stride_h); i < end; i++) {
                const float *in = x + (c * s.h + i * s.stride_h + top) * s.w;
                float *out = map + i * s.out_w;
                for (int j = from; j < to; j++) {
                    out[j] += w * in[j * s.stride_w + left];
                }
            }
        }
    }
}

/* == depthwise */
/* The convolution of each channel alone, weights [c][kernel_h][kernel_w]. */
static void depthwise(const float *x, float *y, const float *weight, const float *bias, struct conv s) {
    struct conv one = s;
    one.c = one.filters = 1;
    for (int c = 0; c < s.c; c++) {
        conv2d(x + c * s.h * s.w, y + c * s.out_h * s.out_w, weight + c * s.kernel_h * s.kernel_w, bias + c, one);
    }
}

/* == dense */
/* [inputs] to [units], weights [units][inputs]. */
static void dense(const float *x, float *y, const float *weight, const float *bias, int inputs, int units) {
    for (int u = 0; u < units; u++) {
        float sum = bias[u];
        for (int i = 0; i < inputs; i++) {
            sum += weight[i] * x[i];
        }
        y[u] = sum;
        weight += inputs;
    }
}

/* == pool */
struct pool {
    int c, h, w, window_h, window_w, stride_h, stride_w, out_h, out_w;
};

/* == max_pool */
/* The largest number of each window. */
static void max_pool(const float *x, float *y, struct pool s) {
    for (int row = 0; row < s.c * s.out_h; row++) {
        const float *in = x + (row / s.out_h * s.h + row % s.out_h * s.stride_h) * s.w;
        for (int j = 0; j < s.out_w; j++) {
            float largest = in[j * s.stride_w];
            for (int k = 0; k < s.window_h; k++) {
                for (int l = 0; l < s.window_w; l++) {
                    float value = in[k * s.w + j * s.stride_w + l];
                    if (value > largest) {
                        largest = value;
                    }
                }
            }
            *y++ = largest;
        }
    }
}

/* == average_pool */
/* The mean of each window. */
static void average_pool(const float *x, float *y, struct pool s) {
    for (int row = 0; row < s.c * s.out_h; row++) {
        const float *in = x + (row / s.out_h * s.h + row % s.out_h * s.stride_h) * s.w;
        for (int j = 0; j < s.out_w; j++) {
            float sum = 0.0f;
            for (int k = 0; k < s.window_h; k++) {
                for (int l = 0; l < s.window_w; l++) {
                    sum += in[k * s.w + j * s.stride_w + l];
                }
            }
            *y++ = sum / (float)(s.window_h * s.window_w);
        }
    }
}

/* == crop */
struct crop {
    int c, h, w, top, left, out_h, out_w;
};

/* The window of each map that begins at (top, left). */
static void crop(const float *x, float *y, struct crop s) {
    for (int row = 0; row < s.c * s.out_h; row++) {
        const float *in = x + (row / s.out_h * s.h + s.top + row % s.out_h) * s.w + s.left;
        for (int j = 0; j < s.out_w; j++) {
            *y++ = in[j];
        }
    }
}

/* == zero_pad */
struct pad {
    int c, h, w, top, left, out_h, out_w;
};

/* Each map from (top, left) on, with zeros around. */
static void zero_pad(const float *x, float *y, struct pad s) {
    for (int i = 0; i < s.c * s.out_h * s.out_w; i++) {
        y[i] = 0.0f;
    }
    for (int row = 0; row < s.c * s.h; row++) {
        float *out = y + (row / s.h * s.out_h + s.top + row % s.h) * s.out_w + s.left;
        for (int j = 0; j < s.w; j++) {
            out[j] = *x++;
        }
    }
}

/* == resample_map */
struct resample {
    int c, h, w, out_h, out_w;
};

/* Weighted sums of rows and columns of each map. A tap is (first position, first weight, end of the weights). */
static void resample_map(const float *x, float *y, const int32_t *rows, const float *row_weights, const int32_t *columns,
                         const float *column_weights, struct resample s) {
    for (int c = 0; c < s.c; c++) {
        for (int i = 0; i < s.out_h; i++) {
            const int32_t *down = rows + 3 * i;
            for (int j = 0; j < s.out_w; j++) {
                const int32_t *across = columns + 3 * j;
                float cell = 0.0f;
                for (int l = across[1]; l < across[2]; l++) {
                    int column = across[0] + l - across[1];
                    float sum = 0.0f;
                    for (int k = down[1]; k < down[2]; k++) {
                        sum += row_weights[k] * x[(c * s.h + down[0] + k - down[1]) * s.w + column];
                    }
                    cell += column_weights[l] * sum;
                }
                *y++ = cell;
            }
        }
    }
}

/* == scale_channels */
/* Batch normalisation: a factor and an offset for each channel. */
static void scale_channels(float *x, int n, const float *factor, const float *offset, int positions) {
    for (int i = 0; i < n; i++) {
        x[i] = x[i] * factor[i / positions] + offset[i / positions];
    }
}

/* == relu */
static float relu(float x) {
    return x > 0.0f ? x : 0.0f;
}

/* == prelu */
/* Each slope serves `repeat` numbers. */
static void prelu(float *x, int n, const float *slope, int repeat) {
    for (int i = 0; i < n; i++) {
        x[i] = x[i] > 0.0f ? x[i] : slope[i / repeat] * x[i];
    }
}

/* == exp */
/* e^x - 1 for x <= 0, relative error below 1e-6: x = k ln 2 + r, and the series of e^r - 1. */
static float expm1_of_negative(float x) {
    union {
        uint32_t bits;
        float value;
    } power;
    x = x > -50.0f ? x : -50.0f;
    int k = (int)(x * 1.44269504f - 0.5f);
    float r = (x - (float)k * 0.693359375f) - (float)k * -2.12194440e-4f;
    float tail = 1.0f / 24.0f + r * (1.0f / 120.0f + r * (1.0f / 720.0f + r * (1.0f / 5040.0f)));
    float series = r + r * r * (0.5f + r * (1.0f / 6.0f + r * tail));
    power.bits = (uint32_t)(k + 127) << 23;
    return power.value * series + (power.value - 1.0f);
}

/* == elu */
static float elu(float x, float alpha) {
    return x > 0.0f ? x : alpha * expm1_of_negative(x);
}

/* == hyperbolic_tangent */
static float hyperbolic_tangent(float x) {
    float e = expm1_of_negative(x > 0.0f ? -2.0f * x : 2.0f * x);
    float size = -e / (e + 2.0f);
    return x > 0.0f ? size : -size;
}

/* == leaky_relu */
static float leaky_relu(float x, float slope) {
    return x > 0.0f ? x : slope * x;
}

/* == softsign */
static float softsign(float x) {
    return x / (1.0f + (x > 0.0f ? x : -x));
}

/* == sigmoid */
/* 1 / (1 + e^-x), from e^-|x|. */
static float sigmoid(float x) {
    float e = expm1_of_negative(x > 0.0f ? -x : x);
    return x > 0.0f ? 1.0f / (e + 2.0f) : (e + 1.0f) / (e + 2.0f);
}
