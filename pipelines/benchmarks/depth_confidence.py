"""How often depths are right at each confidence, on scenes traced ray by ray.

    python pipelines/benchmarks/depth_confidence.py [--scenes 16] [--seed 1000] [--fit]

Photographs at random slopes from -5 to 6, every other scene with a nearer one before half of it;
lenslets of 9 to 15 pixels, pupils of several widths, noise of 0, 0.3, 1 and 3 %. --fit takes the
photographs that LOOKS was fitted on, else six others, and prints the same for other values of it.
Prints the share that is right within a slope of one by confidence, and errors over the standard
deviation.
"""

import argparse

import numpy as np
import skimage.data
from scipy.ndimage import gaussian_filter, map_coordinates

from plenocli.inverse.lightfield import depth as module
from plenocli.inverse.lightfield.planes import distance_of
from plenocli.inverse.lightfield.samples import SampleBands, collect

FOCAL, IMAGE, GAP, PITCH, COUNT = 0.05, 0.055, 0.5e-3, 55e-6, 28
FITTED = ("camera", "coins", "page", "moon", "brick", "grass")
OTHERS = ("astronaut", "coffee", "chelsea", "gravel", "rocket", "cat")
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.001)


def texture(rng, names):
    """Radiance at places (x, y) in lenslet pitches."""
    photo = getattr(skimage.data, rng.choice(names))() / 255.0
    photo = gaussian_filter(photo if photo.ndim == 2 else photo[..., :3].mean(axis=-1), 0.7)
    zoom, (down, right) = rng.uniform(1.5, 9), rng.uniform(100, 300, 2)
    return lambda x, y: map_coordinates(
        photo, [zoom * y + down, zoom * x + right], order=1, mode="mirror"
    )


def places(distance, pixels, fine):
    """(x, y) on the object's image, pitches, of the rays of `fine` x `fine` points a pixel."""
    side = COUNT * pixels * fine
    pixel = PITCH * (1 + GAP / IMAGE) / pixels
    place = ((np.arange(side) + 0.5) / fine - COUNT * pixels / 2) * pixel
    lenslet = (np.arange(side) // (pixels * fine) - (COUNT - 1) / 2) * PITCH
    lens = lenslet - (place - lenslet) * IMAGE / GAP
    direction = (lenslet - lens) / IMAGE + lens / FOCAL
    at = -(lens - direction * distance) * IMAGE / distance / PITCH
    return np.meshgrid(at, at)


def traced(rng, names, two):
    """(samples, true slopes (row, column)) of a scene."""
    pixels, fine, noise = int(rng.integers(9, 16)), 2, rng.choice([0.0, 0.003, 0.01, 0.03])
    far = rng.uniform(-5, 6)
    near = far + rng.uniform(1.2, 3.5)
    behind, before, cut = texture(rng, names), texture(rng, names), rng.uniform(-4, 4)
    z_far, z_near = distance_of(np.array([far, near]), FOCAL, IMAGE, GAP).tolist()
    light, true = behind(*places(z_far, pixels, fine)), np.full((COUNT, COUNT), far)
    if two:
        x, y = places(z_near, pixels, fine)
        light = np.where(x > cut, before(x, y), light)
        true[:, np.arange(COUNT) - (COUNT - 1) / 2 > cut] = near
    light = light.reshape(COUNT * pixels, fine, COUNT * pixels, fine).mean(axis=(1, 3))
    rows, columns = np.indices(light.shape)
    middle, radius = (pixels - 1) / 2, 0.5 * pixels * rng.uniform(0.85, 1)
    white = 1.0 * (np.hypot(rows % pixels - middle, columns % pixels - middle) <= radius)
    light = (light + noise * rng.normal(size=light.shape)) * white
    line = (np.arange(COUNT) + 0.5) * pixels - 0.5
    centres = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    return collect(light, white, centres, np.ones((COUNT, COUNT), bool), pixels), true


def judged(scenes):
    """(confidence, error, error over sigma, whether one thing hides another) of known lenslets."""
    found, inner = [], (slice(2, -2), slice(2, -2))
    for number, (samples, true) in enumerate(scenes):
        depth, _ = module.depth_in_reach(
            SampleBands.of(samples, true.shape), np.linspace(-3, 3, 13).tolist()
        )
        error = np.abs(depth.slope - true)[inner]
        known = np.isfinite(error)
        two = np.full(known.sum(), number % 2 == 1)
        away = error / depth.sigma[inner]
        found.append([depth.confidence[inner][known], error[known], away[known], two])
    return [np.concatenate(part) for part in zip(*found, strict=True)]


def told(scenes):
    """Print what came of the scenes."""
    confidence, error, away, two = judged(scenes)
    sure, right = confidence >= 0.9, error < 1
    for low, high in zip(LEVELS, LEVELS[1:]):
        some = (confidence >= low) & (confidence < high)
        if some.any():
            print(
                f"  {low:.2f} to {min(high, 1):.2f}: right {right[some].mean():.3f}, "
                f"said {confidence[some].mean():.3f}, {some.mean():.1%} of the known"
            )
    print(
        f"  0.9 and more: right {right[sure].mean():.3f}; one thing {right[sure & ~two].mean():.3f}"
        f", two {right[sure & two].mean():.3f}"
    )
    print("  below 1, 2, 5 sigma: " + ", ".join(f"{(away < k).mean():.3f}" for k in (1, 2, 5)))


def main():
    """As said above."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--fit", action="store_true")
    asked = parser.parse_args()
    names = FITTED if asked.fit else OTHERS
    scenes = [
        traced(np.random.default_rng(asked.seed + k), names, two=k % 2 == 1)
        for k in range(asked.scenes)
    ]
    for looks in (8, 12, 20, 30) if asked.fit else (module.LOOKS,):
        module.LOOKS = float(looks)
        print(f"LOOKS = {looks:g}, {asked.scenes} scenes")
        told(scenes)


if __name__ == "__main__":
    main()
