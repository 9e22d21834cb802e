"""What quantised and noisy input does to curvature at each sigma.

    python -m benchmarks.noise [--quick]

Waves of 64 px, steep ones (rms mean curvature 0.017 1/px) and gentle ones (0.0035), as normals of 8 and 16 bits, with
noise of 1/100, and as heights that 256 levels span, or 65,536, or with noise of a hundredth of a pixel. The error is
that of the mean curvature, rms, against the exact input's at the same sigma, as a fraction of the exact one's rms.
"""

from __future__ import annotations

import sys
import warnings

import jax.numpy as jnp
import numpy as np
from tests.reference.descriptor import waves

import shapeenh as se
from benchmarks.harness import table, write

SIZE = (240, 320)
AMPLITUDES = {"steep": 5.0, "gentle": 1.0}


def rounded(values, bits: int):
    """Values in [0, 1] as an image of so many bits holds them."""
    return np.round(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def inputs(amplitude: float, rng) -> dict:
    """name -> (the G-buffer without flaw, the same with it)."""
    fields, _ = waves(*SIZE, amplitude=amplitude)
    normal, height = np.float32(fields["normal"]), 1000 - fields["depth"]
    colours = 0.5 + 0.5 * fields["normal"]
    exact = se.gbuffer_from_normals(normal)
    smooth = se.gbuffer_from_height(np.float32(height), spacing=1.0)
    low, high = height.min(), height.max()

    def levels(bits):
        return low + rounded((height - low) / (high - low), bits) / (2**bits - 1) * (high - low)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they say what is measured here
        normals = {f"normals, {bits} bit": se.gbuffer_from_normals(rounded(colours, bits)) for bits in (8, 16)}
    noisy = normal + np.float32(0.01 * rng.standard_normal(normal.shape))
    normals["normals, noise 0.01"] = se.gbuffer_from_normals(noisy, check=False)
    heights = {f"heights, {bits} bit": levels(bits) for bits in (8, 16)}
    heights["heights, noise 0.01 px"] = height + 0.01 * rng.standard_normal(height.shape)
    rough = {name: se.gbuffer_from_height(np.float32(h), spacing=1.0) for name, h in heights.items()}
    return {k: (exact, g) for k, g in normals.items()} | {k: (smooth, g) for k, g in rough.items()}


def mean_curvature(gbuffer, sigma: float) -> np.ndarray:
    return np.asarray(se.mean_curvature(se.describe(gbuffer, sigma=jnp.float32(sigma)).hessian), np.float64)


def main(quick: bool) -> None:
    sigmas = (0.0, 2.0, 8.0) if quick else (0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.7, 8.0)
    rows = []
    for surface, amplitude in AMPLITUDES.items():
        for name, (exact, flawed) in inputs(amplitude, np.random.default_rng(0)).items():
            row: dict = {"surface": surface, "input": name}
            for sigma in sigmas:
                wanted = mean_curvature(exact, sigma)
                error = np.sqrt(np.mean((mean_curvature(flawed, sigma) - wanted) ** 2))
                row[f"{sigma:g}"] = float(f"{error / np.sqrt(np.mean(wanted**2)):.2g}")
            rows.append(row)
    print(table(rows))
    write("noise", rows, unit="rms error of mean curvature / rms mean curvature, per sigma in px")


if __name__ == "__main__":
    main("--quick" in sys.argv)
