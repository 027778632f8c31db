"""Convert anybody's videos for `python diswm.py pretrain --videos TO`.

A video is an .npz with an array `image`, uint8 (T, 64, 64, 3), like the authors' published ones.
"""

import io
from pathlib import Path

import common
import numpy as np
from tqdm import tqdm

import diswm


def read_video(path):
    """The images of an .npz file. UserError, which names the file, if they are none."""
    with diswm.reading(path, "video", "remove it"):
        image = np.load(path, allow_pickle=False)["image"]
        if image.dtype != np.uint8 or image.shape[1:] != (64, 64, 3) or len(image) == 0:
            raise ValueError(f"image is {image.dtype} {image.shape}, not uint8 (T, 64, 64, 3)")
    return image

def import_videos(source, target):
    """Convert all .npz files of a folder. Returns how many."""
    paths = sorted(source.glob("*.npz"))
    if not paths:
        raise diswm.UserError(f"there are no *.npz in {source}")
    target.mkdir(parents=True, exist_ok=True)
    for path in tqdm(paths, "videos", leave=False, disable=None):
        image, file = read_video(path), io.BytesIO()
        episode = np.zeros(len(image), diswm.VIDEO_ROW)
        episode["image"], episode["is_first"][0] = image, True
        np.save(file, episode)
        diswm.write_whole(target / f"{path.stem}.npy", file.getbuffer())
    return len(paths)

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, metavar="FROM", help="folder of videos, *.npz")
    parser.add_argument("target", type=Path, metavar="TO", help="folder for episodes, *.npy")
    args = parser.parse_args(argv)
    print(f"{args.target}: {import_videos(args.source, args.target)} videos")

if __name__ == "__main__":
    common.run_script(main)
