"""Writes preprocessing.json: what OpenCV makes of formula images, for every resize and colour space of a recipe.

All work is on 8-bit images, as in the write-ups. Samples are taken at hashed places of the planar [c][h][w] output.

    python make_preprocessing.py [--compare]

`--compare` writes nothing: it prints how far this OpenCV (another version, say, or another processor) lies from the file.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from formula import hashed

SAMPLES = 1024
PATH = Path(__file__).with_name("preprocessing.json")


def road(height, width):
    """Gradients, hard edges every 16 pixels and noise of +-32 grey levels: [height, width, RGB]."""
    y, x = np.mgrid[0:height, 0:width]
    gradients = np.stack(
        [x * 255 // (width - 1), y * 255 // (height - 1), (x + y) * 255 // (width + height - 2)], axis=-1
    )
    edges = np.where((x // 16 + y // 16) % 2 == 0, -40, 40)[..., None]
    noise = (hashed("road", height * width * 3) >> np.uint64(24)).astype(np.int64) % 65 - 32
    return np.clip(gradients + edges + noise.reshape(height, width, 3), 0, 255).astype(np.uint8)


def colours(height, width):
    """Two grey ramps, the corners of the RGB cube, then random, dark and nearly grey colours: [height, width, RGB]."""
    h = (hashed("colours", height * width * 3) >> np.uint64(24)).astype(np.int64).reshape(height, width, 3)
    image = h.copy()
    image[height // 2 : height * 3 // 4] //= 8
    nearly_grey = h[height * 3 // 4 :]
    image[height * 3 // 4 :] = np.clip(nearly_grey[..., :1] + nearly_grey % 9 - 4, 0, 255)
    x = np.arange(width)
    image[0] = (4 * x % 256)[:, None]
    image[1] = (4 * x % 256 + 3)[:, None]
    image[2] = np.stack([255 * (x & 1), 255 * (x >> 1 & 1), 255 * (x >> 2 & 1)], axis=-1)
    return image.astype(np.uint8)


IMAGES = {"road": road, "colours": colours}
INTERPOLATIONS = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}
CONVERSIONS = {
    "rgb": lambda rgb: rgb,
    "yuv": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV),
    # Up to OpenCV 3.1 RGB2YUV took red for blue and blue for red.
    "yuv-old": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_BGR2YUV),
    "hsv": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV),
    "saturation": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV)[..., 1],
    "hls": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2HLS),
    "lab": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB),
    "gray": lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
}


def case(name, image, size, rows=None, resize=None, interpolation="linear", colour="rgb", colour_first=False, blur=False):
    return {
        "name": name,
        "image": image,
        "size": list(size),
        "rows": list(rows or (0, size[0])),
        "resize": list(resize or ((rows or (0, size[0]))[1] - (rows or (0, size[0]))[0], size[1])),
        "interpolation": interpolation,
        "colour": colour,
        "colour_first": colour_first,
        "blur": blur,
    }


FRAME = (160, 320)
CASES = [
    # The three recipes, whole.
    case("hyper", "road", FRAME, (60, 140), (40, 160)),
    case("lenet", "road", FRAME, (40, 138), (64, 64), "area", "saturation", colour_first=True),
    case("pilotnet", "road", FRAME, (60, 135), (66, 200), "linear", "yuv"),
    # Resizes by themselves, heights and widths in both directions, whole factors and others.
    case("area 98x320 to 64x64", "road", FRAME, (40, 138), (64, 64), "area"),
    case("area 75x320 to 66x200", "road", FRAME, (60, 135), (66, 200), "area"),
    case("area by 2x2", "road", FRAME, (60, 140), (40, 160), "area"),
    case("area by 2x4", "road", FRAME, None, (80, 80), "area"),
    case("area 50x70 to 33x41", "road", (50, 70), None, (33, 41), "area"),
    case("area up 50x70 to 67x93", "road", (50, 70), None, (67, 93), "area"),
    case("linear 98x320 to 64x64", "road", FRAME, (40, 138), (64, 64)),
    case("linear up 50x70 to 65x91", "road", (50, 70), None, (65, 91)),
    case("linear 160x320 to 208x416", "road", FRAME, None, (208, 416)),
    case("linear 50x70 to 65x50", "road", (50, 70), None, (65, 50)),
    case("linear 120x160 to 160x320", "road", (120, 160), None, (160, 320)),
    # Smoothed before.
    case("blur", "road", (50, 70), blur=True),
    case("blur 90x320 to 66x200", "road", FRAME, (50, 140), (66, 200), "area", "yuv", blur=True),
    case("blur colours", "colours", (64, 64), None, (33, 41), colour="hsv", colour_first=True, blur=True),
    # Colour spaces by themselves.
    *(case(f"colour {colour}", "colours", (64, 64), colour=colour) for colour in CONVERSIONS if colour != "rgb"),
]


def output(c):
    """The planar [c][h][w] result of one case."""
    image = IMAGES[c["image"]](*c["size"])[c["rows"][0] : c["rows"][1]]
    if c["blur"]:
        image = cv2.GaussianBlur(image, (3, 3), 0)
    if c["colour_first"]:
        image = CONVERSIONS[c["colour"]](image)
    height, width = c["resize"]
    if (height, width) != image.shape[:2]:
        image = cv2.resize(image, (width, height), interpolation=INTERPOLATIONS[c["interpolation"]])
    if not c["colour_first"]:
        image = CONVERSIONS[c["colour"]](image)
    assert image.dtype == np.uint8
    return np.ascontiguousarray(image.reshape(height, width, -1).transpose(2, 0, 1))


def summarise(c, planes):
    places = hashed(f"place/{c['name']}", SAMPLES) % np.uint64(planes.size)
    return c | {
        "shape": list(planes.shape),
        "means": [round(float(plane.mean()), 6) for plane in planes],
        "samples": [int(v) for v in planes.ravel()[places.astype(np.int64)]],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compare", action="store_true", help="print the distance to the file, write nothing")
    args = parser.parse_args()
    results = [summarise(c, output(c)) for c in CASES]
    if args.compare:
        print(f"OpenCV {cv2.__version__} against the file")
        for was, now in zip(json.loads(PATH.read_text(encoding="utf-8"))["cases"], results, strict=True):
            off = np.abs(np.array(was["samples"]) - np.array(now["samples"]))
            print(f"{was['name']:28} largest {off.max():3}  mean {off.mean():.4f}")
        return
    rows = [json.dumps(result, separators=(",", ":")) for result in results]
    made_by = f"make_preprocessing.py, OpenCV {cv2.__version__}"
    text = f'{{\n  "made_by": "{made_by}",\n  "cases": [\n' + ",\n".join(rows) + "\n  ]\n}\n"
    PATH.write_text(text, encoding="utf-8", newline="\n")
    print(f"{PATH.name}: {len(rows)} cases, {len(text)} bytes")


if __name__ == "__main__":
    main()
