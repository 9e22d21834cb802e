"""The sums over lights: `python -m benchmarks.light [--peer FILE]`.

A ball with fine bumps that covers 170,000 of 800 x 600 pixels, and the same pixels with random normals, where no light
can be left out. LW09 reports 37 frames per second with 54 lights on its GPU. `--peer` names a Python file with
`shade(normal [3, P], hessian 3 x [P], direction [N, 3], radiance [N, 3], alpha)`, timed in turns on the covered pixels
alone.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness

HEIGHT, WIDTH, COVERED = 600, 800, 170_000
WARP = {"alpha": 30.0, "gamma": 0.3}
SCALE = {"invariant": 0.4, "gamma_diffuse": 2.0, "gamma_specular": 1.0}


def ball(covered: int, *, random: bool = False, seed: int = 0):
    """(G-buffer, descriptor) of a bumpy ball that covers so many pixels."""
    radius = np.sqrt(covered / np.pi)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (column + 0.5 - WIDTH / 2) / radius, (HEIGHT / 2 - row - 0.5) / radius
    mask = x * x + y * y < 1
    rng = np.random.default_rng(seed)
    if random:
        normal = rng.normal(size=(HEIGHT, WIDTH, 3))
        normal[..., 2] = np.abs(normal[..., 2])
    else:
        z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
        normal = np.stack([x + 0.2 * np.sin(23 * x), y + 0.2 * np.sin(19 * y), z + 0.05], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    hessian = rng.normal(size=(HEIGHT, WIDTH, 3)) * 0.02
    normal, hessian = (jnp.asarray(a * mask[..., None], jnp.float32) for a in (normal, hessian))
    plane = jnp.ones((HEIGHT, WIDTH))
    gbuffer = se.GBuffer(jnp.asarray(mask), plane, normal, normal)
    return gbuffer, se.Descriptor(hessian, hessian[..., :2], plane, plane, plane)


def lights_of(count: int) -> se.Lights:
    return se.sample_environment(se.procedural_studio(), count)


def material() -> se.Material:
    return se.Material(jnp.full(3, 0.6), jnp.full(3, 0.05), jnp.asarray(50.0))


def peer_call(path: Path, gbuffer, descriptor, lights):
    spec = importlib.util.spec_from_file_location("peer", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    inside = np.asarray(gbuffer.mask)
    pad = -inside.sum() % 64  # the peer wants a multiple of 64 pixels
    normal, hessian = (np.asarray(a)[inside].T for a in (gbuffer.normal, descriptor.hessian))
    normal, hessian = (jnp.asarray(np.pad(a, ((0, 0), (0, pad)), mode="edge")) for a in (normal, hessian))
    return lambda: module.shade(normal, hessian, lights.direction, lights.radiance, jnp.float32(WARP["alpha"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", type=Path, help="file with a function to compare with")
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    rows = []

    def run(scene: str, calls: dict, **facts):
        for name, times in harness.measure(calls, repeats=arguments.repeats, seconds=60).items():
            rows.append({"scene": scene, "call": name, **facts, **times})

    # The ways to shade, on both scenes.
    lights, m = lights_of(54), material()
    for scene, random in (("ball", False), ("random", True)):
        g, d = ball(COVERED, random=random)
        calls = {
            "plain": lambda g=g: se.shade(g, lights, m),
            "warped": lambda g=g, d=d: se.shade_warped(g, d, lights, m, **WARP),
            "scaled": lambda g=g, d=d: se.shade_scaled(g, d, lights, m, **SCALE),
            "scaled, anisotropic": lambda g=g, d=d: se.shade_scaled(g, d, lights, m, anisotropy=0.5, **SCALE),
            "scaled and warped": lambda g=g, d=d: se.shade_scaled(g, d, lights, m, alpha=30.0, **SCALE),
        }
        if arguments.peer:
            calls["peer"] = peer_call(arguments.peer, g, d, lights)
        run(scene, calls, lights=54, covered=int(g.mask.sum()))

    # Value and gradient.
    g, d = ball(COVERED)

    def loss(alpha, gamma, material, radiance, g, d, direction):
        image = se.shade_warped(g, d, se.Lights(direction, radiance), material, alpha=alpha, gamma=gamma)
        return jnp.mean(image * image)

    given = jnp.float32(30.0), jnp.float32(0.3), m, lights.radiance, g, d, lights.direction
    value, gradient = jax.jit(loss), jax.jit(jax.value_and_grad(loss, (0, 1, 2, 3)))
    run("ball", {"value": lambda: value(*given), "value and gradient": lambda: gradient(*given)}, lights=54)

    # Linear in lights and in covered pixels; memory.
    by_count = {n: lights_of(n) for n in (16, 32, 64, 128, 256, 512)}
    calls = {f"warped, {n} lights": lambda l=l: se.shade_warped(g, d, l, m, **WARP) for n, l in by_count.items()}
    run("ball", calls, covered=int(g.mask.sum()))
    balls = {covered: ball(covered) for covered in (5_000, 20_000, 80_000, 170_000)}
    calls = {f"warped, {c} pixels": lambda s=s: se.shade_warped(*s, lights, m, **WARP) for c, s in balls.items()}
    run("ball", calls, lights=54)
    print(harness.table(rows))
    memory = {count: temporaries(g, d, lights_of(count), m) for count in (64, 512, 4096)}
    print("temporaries, MiB, by number of lights:", memory)
    said = conclude(rows)
    print(harness.write("light", rows, temporaries_mib=memory, answer=said))
    print(said)


def conclude(rows: list[dict]) -> str:
    ms = {(r["scene"], r["call"]): r["median_ms"] for r in rows}
    warped, of = ms["ball", "warped"], lambda call: ms["ball", call] / ms["ball", "warped"]
    gradient = ms["ball", "value and gradient"] / ms["ball", "value"]
    beside = f", {1 / of('peer'):.2f} of the peer's time" if ("ball", "peer") in ms else ""
    return (
        f"54 warped lights over 170,000 pixels take {warped:.0f} ms{beside}. Of that time plain light takes "
        f"{of('plain'):.2f}, radiance scaling {of('scaled'):.2f}, both {of('scaled and warped'):.2f}; a value with its "
        f"gradient takes {gradient:.1f} times the value's."
    )


def temporaries(gbuffer, descriptor, lights, material) -> float:
    """MiB of temporaries of the compiled gradient."""

    def loss(alpha, radiance):
        image = se.shade_warped(gbuffer, descriptor, se.Lights(lights.direction, radiance), material, alpha=alpha)
        return jnp.mean(image * image)

    analysis = jax.jit(jax.grad(loss, (0, 1))).lower(1.0, lights.radiance).compile().memory_analysis()
    return round(analysis.temp_size_in_bytes / 2**20, 1)


if __name__ == "__main__":
    main()
