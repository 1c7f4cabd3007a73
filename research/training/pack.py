"""Pack images and videos into a data folder: grey JPEGs of at most 1600 (photographs) or 960 pixels (video), and
INDEX.tsv.

    python pack.py --out DATA --source NAME --licence CC0-1.0 [--split train|val] [--start 0] [--count 150] FILE...

Images become photographs; all other files are read as video. Repeated calls add to the folder. Without --split, every
fifth file is for validation.
"""
import argparse
import csv
import os

import cv2
import numpy as np

COLUMNS = ('path', 'source', 'licence', 'frames', 'cuts_before_frame')
IMAGES = ('.jpg', '.jpeg', '.png', '.webp', '.tif', '.tiff')


def shrink(image, longest):
    scale = min(1., longest / max(image.shape[:2]))
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray


def read_video(path, start, count):
    video, frames = cv2.VideoCapture(path), []
    for _ in range(start):
        video.grab()
    while len(frames) < count:
        ok, frame = video.read()
        if not ok:
            break
        frames.append(shrink(frame, 960))
    return frames


def cuts(frames):
    """Frames that start a new shot: their change from the previous frame is far above the clip's usual change."""
    small = [cv2.resize(f, (64, 36), interpolation=cv2.INTER_AREA).astype(np.float32) for f in frames]
    change = np.array([0.] + [float(np.abs(b - a).mean()) for a, b in zip(small, small[1:])])
    return [i for i, c in enumerate(change) if c > max(20., 5 * np.median(change))]


def write(path, image):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    if not cv2.imwrite(path, image, [cv2.IMWRITE_JPEG_QUALITY, 92]):
        raise SystemExit(f'cannot write {path}')


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('files', nargs='+')
    p.add_argument('--out', required=True)
    p.add_argument('--source', required=True)
    p.add_argument('--licence', required=True)
    p.add_argument('--split', choices=('train', 'val'))
    p.add_argument('--start', type=int, default=0, help='first frame of a video')
    p.add_argument('--count', type=int, default=150, help='frames of a video at most')
    a = p.parse_args()
    os.makedirs(a.out, exist_ok=True)
    index = os.path.join(a.out, 'INDEX.tsv')
    fresh = not os.path.exists(index)
    with open(index, 'a', encoding='utf8', newline='') as f:
        rows = csv.DictWriter(f, COLUMNS, delimiter='\t')
        if fresh:
            rows.writeheader()
        for i, file in enumerate(sorted(a.files)):
            split = a.split or ('val' if i % 5 == 4 else 'train')
            name = f'{a.source}__{os.path.splitext(os.path.basename(file))[0]}'
            if file.lower().endswith(IMAGES):
                image = cv2.imread(file)
                if image is None:
                    raise SystemExit(f'cannot read {file}')
                path, count, breaks = f'photos/{split}/{name}.jpg', 1, []
                write(os.path.join(a.out, path), shrink(image, 1600))
            else:
                frames = read_video(file, a.start, a.count)
                if not frames:
                    raise SystemExit(f'cannot read {file}')
                path, count, breaks = f'clips/{split}/{name}/', len(frames), cuts(frames)
                for k, frame in enumerate(frames):
                    write(os.path.join(a.out, path, f'{k:04d}.jpg'), frame)
            rows.writerow({'path': path, 'source': a.source, 'licence': a.licence, 'frames': count,
                           'cuts_before_frame': ','.join(map(str, breaks))})
            print(path, count, breaks)


if __name__ == '__main__':
    main()
