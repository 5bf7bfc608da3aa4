"""What a training run must know of captures: depth range of each photo, overlap of each pair.

    python pairs.py data [NAME ...]

Reads what captures.py wrote and writes `data/<name>/pairs.npz` beside it: SIFT matches of each photo
with its nearest ones, kept where the given poses agree, triangulated.

inverse [N,3]   1, 50 and 99 % quantile of the inverse depth of a photo's points; NaN without enough
overlap [N,N]   share of a photo's points that fall into another photo
gain    [N,3]   log of each photo's exposure and white balance against the median photo (BGR)
px      [M,3]   photo, photo, median Sampson distance of their poses in pixels, of all matches
"""
import json
import os
import sys

import cv2
import numpy as np

NEAR = 8  # photos that each is matched with
RATIO = 0.78
AGREE = 1.5  # pixels
POINTS_MIN = 25


def skew(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def sampson(F, a, b):
    la, lb = a @ F.T, b @ F
    return np.abs((b * la).sum(1)) / np.sqrt((la[:, :2] ** 2).sum(1) + (lb[:, :2] ** 2).sum(1) + 1e-12)


def partners(c2w):
    """Pairs of photos that look the same way from near by."""
    c, ax = c2w[:, :3, 3], c2w[:, :3, 2]
    d = np.linalg.norm(c[:, None] - c[None], axis=2)
    angle = np.arccos(np.clip(ax @ ax.T, -1, 1))
    scale = np.median(np.sort(d + np.eye(len(c)) * 1e9, 1)[:, 0])
    cost = d / scale + 12 * angle
    cost[(angle > 1.1) | (np.eye(len(c)) > 0)] = np.inf
    found = set()
    for i in range(len(c)):
        order = np.argsort(cost[i])
        # The nearest ones and some farther away: narrow and wide baselines.
        for j in [*order[: NEAR // 2], *order[NEAR // 2 : 2 * NEAR : 2]]:
            if np.isfinite(cost[i, j]):
                found.add((min(i, j), max(i, j)))
    return sorted(found)


def match(fa, fb):
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    two = matcher.knnMatch(fa, fb, k=2)
    kept = {}
    for pair in two:
        if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance:
            m = pair[0]
            if m.trainIdx not in kept or kept[m.trainIdx].distance > m.distance:
                kept[m.trainIdx] = m
    return np.array([[m.queryIdx, m.trainIdx] for m in kept.values()], int).reshape(-1, 2)


def measure(folder):
    with open(os.path.join(folder, "cameras.json")) as file:
        frames = json.load(file)["frames"]
    n = len(frames)
    c2w, K = np.array([f["c2w"] for f in frames]), np.array([f["K"] for f in frames])
    sift = cv2.SIFT_create(nfeatures=1500, contrastThreshold=0.02)
    images, points, features = [], [], []
    for f in frames:
        img = cv2.imread(os.path.join(folder, f["file"]))
        keys, desc = sift.detectAndCompute(cv2.cvtColor(img, cv2.COLOR_BGR2GRAY), None)
        images.append(img)
        points.append(np.array([[*k.pt, 1.0] for k in keys]).reshape(-1, 3) + [0.5, 0.5, 0])
        features.append(desc)
    world = [[] for _ in range(n)]
    px, gains = [], []
    for i, j in partners(c2w):
        if features[i] is None or features[j] is None:
            continue
        m = match(features[i], features[j])
        if len(m) < 12:
            continue
        a, b = points[i][m[:, 0]], points[j][m[:, 1]]
        rel = np.linalg.inv(c2w[j]) @ c2w[i]
        F = np.linalg.inv(K[j]).T @ skew(rel[:3, 3]) @ rel[:3, :3] @ np.linalg.inv(K[i])
        far = sampson(F, a, b)
        # What no fundamental matrix explains is a false match: it tells nothing of the poses.
        _, ok = cv2.findFundamentalMat(a[:, :2], b[:, :2], cv2.FM_RANSAC, 3.0, 0.99)
        if ok is not None and ok.sum() >= 12:
            px.append((i, j, np.median(far[ok[:, 0] > 0])))
        good = far < AGREE
        if good.sum() < 8:
            continue
        ra, rb = a[good] @ np.linalg.inv(K[i]).T @ c2w[i][:3, :3].T, b[good] @ np.linalg.inv(K[j]).T @ c2w[j][:3, :3].T
        ua, ub = ra / np.linalg.norm(ra, axis=1, keepdims=True), rb / np.linalg.norm(rb, axis=1, keepdims=True)
        w, k = c2w[i][:3, 3] - c2w[j][:3, 3], (ua * ub).sum(1)
        da, db = (ua * w).sum(1), (ub * w).sum(1)
        den = np.maximum(1 - k * k, 1e-9)
        sa, sb = (k * db - da) / den, (db - k * da) / den
        seen = (np.arccos(np.clip(k, -1, 1)) > np.radians(0.7)) & (sa > 0) & (sb > 0)
        at = (c2w[i][:3, 3] + ua * sa[:, None] + c2w[j][:3, 3] + ub * sb[:, None]) / 2
        world[i].append(at[seen])
        world[j].append(at[seen])
        pa, pb = a[good][:, :2].astype(int), b[good][:, :2].astype(int)
        ca, cb = cv2.blur(images[i], (5, 5))[pa[:, 1], pa[:, 0]], cv2.blur(images[j], (5, 5))[pb[:, 1], pb[:, 0]]
        gains.append((i, j, *np.median(np.log(ca + 8.0) - np.log(cb + 8.0), 0)))
    inverse, overlap = np.full((n, 3), np.nan), np.zeros((n, n))
    world = [np.concatenate(p) if p else np.zeros((0, 3)) for p in world]
    for i in range(n):
        z = (world[i] - c2w[i][:3, 3]) @ c2w[i][:3, 2]
        if len(z) < POINTS_MIN:
            continue
        inverse[i] = np.quantile(1 / z[z > 0], [0.01, 0.5, 0.99])
        for j in range(n):
            local = (world[i] - c2w[j][:3, 3]) @ c2w[j][:3, :3]
            p = local @ K[j].T
            uv = p[:, :2] / np.maximum(p[:, 2:], 1e-9)
            inside = (p[:, 2] > 0) & (uv >= 0).all(1) & (uv < [frames[j]["width"], frames[j]["height"]]).all(1)
            overlap[i, j] = inside.mean()
    facing = c2w[:, :3, 2] @ c2w[:, :3, 2].T > 0.3
    np.savez_compressed(os.path.join(folder, "pairs.npz"), inverse=inverse, overlap=overlap * facing,
                        gain=exposures(n, gains), px=np.array(px))
    px = np.array(px)[:, 2]
    known = ~np.isnan(inverse[:, 0])
    print(f"{os.path.basename(folder):10} photos {n:3} with range {known.sum():3} pairs {len(px):4} px {np.median(px):.2f} p90 {np.quantile(px, .9):.2f}"
          f" span {np.nanmedian(inverse[:, 2] / np.maximum(inverse[:, 0], 1e-9)):.1f} gain {np.abs(exposures(n, gains)).mean():.3f} max {np.abs(exposures(n, gains)).max():.2f}", flush=True)


def exposures(n, gains):
    """Least squares of the pairs' log ratios, median 0."""
    if not gains:
        return np.zeros((n, 3))
    g = np.array(gains)
    A = np.zeros((len(g) + n, n))
    A[np.arange(len(g)), g[:, 0].astype(int)] = 1
    A[np.arange(len(g)), g[:, 1].astype(int)] = -1
    A[len(g) :] = 0.1 * np.eye(n)
    x = np.linalg.lstsq(A, np.concatenate([g[:, 2:], np.zeros((n, 3))]), rcond=None)[0]
    return x - np.median(x, 0)


def main():
    root = sys.argv[1]
    for name in sys.argv[2:] or sorted(os.listdir(root)):
        if os.path.exists(os.path.join(root, name, "cameras.json")):
            measure(os.path.join(root, name))


if __name__ == "__main__":
    main()
