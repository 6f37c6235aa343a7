"""Measure streamed principal components of the lower face over many samples: accuracy, time and memory.

    python -m bench.model_building [--samples 20000] [--components 150] [--memory-gb 4]

Samples are generated while they are read, never stored: 400 smooth modes of the first model's lower-face skin whose
variances decrease with the power 1.5 of their number, random coefficients, and noise of 0.05 mm. The method is chosen
by size, as in model building. The truth is the covariance of the modes. The last rows give seconds, peak memory of the
process, and an estimate for 150,000 samples: the time of a pass is proportional to the number of samples, the memory
does not depend on it.

Of 150,000 x 53,463 float32 (all vertices of the official mesh) the samples alone are 32 GB, their covariance 23 GB in
float64; the lower face is 9,764 of its vertices.
"""

import argparse
import resource
import time
from collections.abc import Iterator

import numpy as np

from coregister.first_model import build
from coregister.region_masks import REGIONS, regional_masks
from registration.geometry.pca import principal_components
from registration.model import gnm_npz

MODES = 400
NOISE_M = 0.05e-3
BLOCK = 256
OFFICIAL = 150_000


class GeneratedSamples:
    """Random samples of D numbers, equal each time they are read."""

    def __init__(self, count: int, modes: np.ndarray):
        self._count, self._modes = count, modes.astype(np.float32)
        self.seconds, self.passes = 0.0, 0

    def __iter__(self) -> Iterator[np.ndarray]:
        rng = np.random.default_rng(0)
        self.passes += 1
        for first in range(0, self._count, BLOCK):
            start = time.perf_counter()
            size = min(BLOCK, self._count - first)
            block = rng.standard_normal((size, len(self._modes)), np.float32) @ self._modes
            block += NOISE_M * rng.standard_normal(block.shape, np.float32)
            self.seconds += time.perf_counter() - start
            yield from block


def smooth_modes(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return MODES orthogonal smooth fields, (M, 3 V), with decreasing standard deviations; the first has 10 mm rms."""
    waves = rng.normal(0, 60, (MODES, 3)), rng.uniform(0, 2 * np.pi, MODES)
    fields = np.cos(waves[0] @ points.T + waves[1][:, None])[:, :, None] * rng.normal(size=(MODES, 1, 3))
    q, _ = np.linalg.qr(fields.reshape(MODES, -1).T)
    return q.T * (10e-3 * np.sqrt(len(points)) * np.arange(1, MODES + 1) ** -0.75)[:, None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--components", type=int, default=150)
    parser.add_argument("--memory-gb", type=float, default=4.0)
    args = parser.parse_args()
    data = gnm_npz.read(build.bootstrap())
    rows = np.flatnonzero(regional_masks(data)[REGIONS.index("lower_face_region")] > 0)
    modes = smooth_modes(data.template_vertex_positions[rows].astype(np.float64), np.random.default_rng(1))
    samples = GeneratedSamples(args.samples, modes)
    start = time.perf_counter()
    principal = principal_components(samples, centred=False, max_components=args.components, memory_gb=args.memory_gb)
    seconds = time.perf_counter() - start
    truth = (modes**2).sum(1) + NOISE_M**2
    error = np.abs(principal.variance / truth[: len(principal.variance)] - 1)
    expected = np.sqrt(2 / args.samples)
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(f"vertices {len(rows)} numbers {3 * len(rows)} samples {args.samples} components {len(principal.variance)}")
    print(f"method {principal.method} passes {samples.passes} seconds_of_generation {samples.seconds:.0f}")
    print(f"variance_error {error.mean():.4f} expected {expected:.4f}")
    print(f"seconds {seconds:.0f}")
    print(f"peak_gb {gigabytes:.2f}")
    factor = OFFICIAL / args.samples
    disk_gb = OFFICIAL * 12 * len(data.template_vertex_positions) / 1e9
    print(f"at_150000 hours {seconds * factor / 3600:.2f} peak_gb {gigabytes:.2f} on_disk_gb {disk_gb:.0f}")


if __name__ == "__main__":
    main()
