"""Convert anybody's videos for `python diswm.py pretrain --videos TO`.

A video is a film (.mp4, .gif and what else imageio reads), a folder of pictures, in the order of
their numbers, or an array: .npy, or .npz with `image`, like the authors' published ones, and
perhaps `is_first`, which marks where episodes begin. Frames may be uint8 or float in [0, 1],
channels last or first, grey, RGB or RGBA (alpha is dropped), of any size: each is resized to
64 × 64 by area. One that is not square is squeezed; --crop takes its middle square instead.
A long video becomes several files of 1000 frames each, of which only one is in memory at a time
(an .npz is unpacked as a whole).
"""

import argparse
import glob
import io
import re
from pathlib import Path

import common
import imageio.v3 as iio
import numpy as np
from PIL import Image
from tqdm import tqdm

import diswm

FILMS = (".mp4", ".gif", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".apng")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".ppm")
CHUNK = 1000  # frames of a file
CONVERT = "it takes uint8 or floats in [0, 1]: (T, H, W), (T, H, W, C) or (T, C, H, W), C 1, 3 or 4"


def pictures_in(folder):
    """Its pictures; frame_10 comes after frame_9."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in PICTURES]
    return sorted(paths, key=lambda path: [int(part) if part.isdecimal() else part
                                           for part in re.split(r"(\d+)", path.name)])

def to_frame(picture, crop=False):
    """A picture (H, W), (H, W, C) or (C, H, W) → uint8 (64, 64, 3)."""
    if picture.ndim == 3 and picture.shape[-1] not in (1, 3, 4):
        picture = np.moveaxis(picture, 0, -1)
    if picture.ndim == 3 and picture.shape[-1] not in (1, 3, 4):
        raise ValueError(f"one of its pictures has {picture.shape[1]} channels")
    if picture.dtype.kind == "f":
        if not (picture.min() >= 0 and picture.max() <= 1):  # nor NaN
            raise ValueError(f"its floats are in [{picture.min():.3g}, {picture.max():.3g}]")
        picture = np.round(picture * 255)
    elif picture.dtype == bool:
        picture = picture * 255
    elif not 0 <= picture.min() <= picture.max() <= 255:
        raise ValueError(f"its numbers are in [{picture.min()}, {picture.max()}]")
    picture = picture.astype(np.uint8)
    if picture.ndim == 3:
        picture = picture[..., 0] if picture.shape[-1] == 1 else picture[..., :3]
    if crop:
        side = min(picture.shape[:2])
        top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
        picture = picture[top:top + side, left:left + side]
    image = Image.fromarray(picture).convert("RGB")
    return np.asarray(image if image.size == (64, 64) else image.resize((64, 64), Image.BOX))

def read_array(path):
    """An .npy or .npz → (frames, is_first (T,) or None)."""
    saved, is_first = np.load(path, mmap_mode="r", allow_pickle=False), None
    if path.suffix.lower() == ".npz":
        is_first, saved = saved.get("is_first"), saved["image"]
    elif saved.dtype.names:  # rows, like ours
        is_first, saved = saved["is_first"], saved["image"]
    channels = {saved.shape[-1], *saved.shape[1:2]} if saved.ndim == 4 else {1}
    one_picture = saved.ndim == 3 and saved.shape[-1] in (1, 3, 4)
    if saved.ndim not in (3, 4) or 0 in saved.shape or one_picture or not channels & {1, 3, 4}:
        raise ValueError(f"its array is {saved.dtype} {saved.shape}")
    if saved.dtype.kind not in "fuib" or is_first is not None and len(is_first) != len(saved):
        raise ValueError(f"its array is {saved.dtype} {saved.shape} with is_first {is_first}")
    if path.suffix.lower() == ".npz":
        return saved, is_first
    # Mapped anew for each frame: what has been read does not stay in memory.
    field = "image" if is_first is not None else ...
    count = range(len(saved))
    return (np.load(path, mmap_mode="r")[field][index] for index in count), is_first

def read_picture(path):
    """A picture file; one of 16 bits in 8."""
    picture = iio.imread(path)
    return picture // 257 if picture.dtype == np.uint16 else picture

def read_video(path):
    """→ (its pictures one by one, is_first (T,) or None)."""
    if path.is_dir():
        return (read_picture(picture) for picture in pictures_in(path)), None
    if path.suffix.lower() in (".npy", ".npz"):
        return read_array(path)
    return iio.imiter(path), None

def import_video(path, target, crop=False):
    """Convert a video into <its name>-<chunk>.npy files. Returns a line that says what was done."""
    name, count, rows, found = path.name, 0, [], ""
    def write():
        episode, file = np.array(rows, diswm.VIDEO_ROW), io.BytesIO()
        np.save(file, episode)
        diswm.write_whole(target / f"{name}-{(count - 1) // CHUNK:05d}.npy", file.getbuffer())
        rows.clear()

    for old in target.glob(f"{glob.escape(name)}-{5 * '[0-9]'}.npy"):
        old.unlink()  # of an import that may have been longer
    with diswm.reading(path, "video", CONVERT):
        pictures, is_first = read_video(path)
        for picture in pictures:
            picture = np.asarray(picture)
            found = found or f"{picture.dtype} {picture.shape}"
            first = count == 0 or bool(is_first is not None and is_first[count])
            rows.append((to_frame(picture, crop), first))
            count += 1
            if len(rows) == CHUNK:
                write()
        if count == 0:
            raise ValueError("there are no frames")
    if rows:
        write()
    way = "its middle square" if crop else "all of it"
    return f"{path}: {count} frames of {found} → uint8 (64, 64, 3), {way}, by area"

def find_videos(source):
    """The videos of a folder, or the one that a path is."""
    if not source.exists():
        raise diswm.UserError(f"there is no {source}")
    if source.is_file():
        return [source]
    known = (*FILMS, ".npy", ".npz")
    paths = [path for path in sorted(source.iterdir()) if path.suffix.lower() in known
             or path.is_dir() and pictures_in(path)]
    pictures = pictures_in(source)
    if pictures and paths:
        raise diswm.UserError(f"{source} holds videos, as {paths[0].name}, and single pictures, as "
                              f"{pictures[0].name}; move one kind elsewhere")
    if pictures:
        return [source]
    if not paths:
        raise diswm.UserError(f"there are no videos in {source}: no *{', *'.join(known)}, and no "
                              "folders of pictures")
    return paths

def import_videos(source, target, crop=False):
    """Convert all videos of a folder, and say so. Returns how many."""
    if source.resolve() == target.resolve():
        raise diswm.UserError(f"{source} cannot be both; name another folder for the episodes")
    paths = [path for path in find_videos(source) if path.resolve() != target.resolve()]
    target.mkdir(parents=True, exist_ok=True)
    for path in tqdm(paths, "videos", leave=False, disable=None):
        print(import_video(path, target, crop))
    return len(paths)

def main(argv=None):
    parser = diswm.Parser(description=__doc__,
                          formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, metavar="FROM", help="folder of videos, or one video")
    parser.add_argument("target", type=Path, metavar="TO", help="folder for episodes, *.npy")
    parser.add_argument("--crop", action="store_true", help="take the middle square")
    args = parser.parse_args(argv)
    count = import_videos(args.source, args.target, args.crop)
    print(f"{args.target}: {count} videos")

if __name__ == "__main__":
    common.run_script(main)
