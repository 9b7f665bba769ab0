"""What the checks of exported models share: the program, the pictures, and the command line."""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from PIL import Image

IMAGES_A_CALL = 500


def run(steersman, *args):
    """What the program prints; its error ends the check."""
    done = subprocess.run([steersman, *args], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"steersman {' '.join(args[:3])} failed: {done.stderr}")
    return done.stdout


def answers(steersman, model, files):
    """What `steersman predict` answers for each file."""
    found = []
    for start in range(0, len(files), IMAGES_A_CALL):
        text = run(steersman, "predict", model, *files[start : start + IMAGES_A_CALL], "--json")
        found += json.loads(text.splitlines()[-1])
    return found


class Pictures:
    """The recorded pictures and some of noise at a size, as PNG files and as arrays, so that both sides see the same pixels."""

    def __init__(self, paths, noise, folder):
        self.paths, self.noise, self.folder, self.sizes = paths, noise, folder, {}

    def of_size(self, height, width):
        if (height, width) not in self.sizes:
            folder = pathlib.Path(self.folder) / f"{height}x{width}"
            folder.mkdir()
            random = np.random.default_rng(1)
            pixels = [np.asarray(Image.open(path).convert("RGB").resize((width, height))) for path in self.paths]
            pixels += [random.integers(0, 256, (height, width, 3), np.uint8) for _ in range(self.noise)]
            files = []
            for index, picture in enumerate(pixels):
                files.append(str(folder / f"{index}.png"))
                Image.fromarray(picture).save(files[-1], compress_level=1)
            self.sizes[height, width] = files, np.stack(pixels)
        return self.sizes[height, width]


def main(description, recorded, check, rows):
    """Checks the models that the command line names. `recorded` gives the paths of a recording's pictures, at most so many `rows`;
    `check` says whether a model holds."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steersman", required=True, help="the program")
    parser.add_argument("--rows", type=int, default=None, help=f"at most so many {rows} of the recording")
    parser.add_argument("--noise", type=int, default=20, help="pictures of noise")
    parser.add_argument("recording", type=pathlib.Path)
    parser.add_argument("models", nargs="+")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        pictures = Pictures(recorded(args.recording, args.rows), args.noise, folder)
        holds = [check(args.steersman, model, pictures, folder) for model in args.models]
    sys.exit(0 if all(holds) else 1)
