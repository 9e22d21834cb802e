"""Inputs that nobody would call ordinary: what hypothesis draws are kinds and exponents, what comes out are arrays of
one shape, so that nothing compiles again from example to example."""

from dataclasses import dataclass

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np

import shapeenh as se

MASKS = ("full", "empty", "one pixel", "checkerboard", "random")
NORMALS = ("unit", "rim", "away", "long", "short", "zero", "axis", "steps")
DEPTHS = (0.0, 1e-6, 1.0, 1e6)
BAD = (None, np.nan, np.inf, -np.inf)
STRENGTHS = (0.0, 1e-30, -1e-6, 1e-3, 2.0, -9.0, 1e4, -1e30, 1e30)
LIGHTS = ("any", "view", "away", "horizon", "opposite", "dark", "bright", "zero")


@dataclass(frozen=True)
class Draw:
    """One example."""

    seed: int
    mask: str
    normal: str
    depth: float
    curvature: int  # exponent
    bad: float | None
    alpha: float
    gamma: float
    light: str


draws = st.builds(
    Draw,
    seed=st.integers(0, 2**16),
    mask=st.sampled_from(MASKS),
    normal=st.sampled_from(NORMALS),
    depth=st.sampled_from(DEPTHS),
    curvature=st.sampled_from((-30, -12, -6, -2, 0, 3, 12, 30)),
    bad=st.sampled_from(BAD),
    alpha=st.sampled_from(STRENGTHS),
    gamma=st.sampled_from((0.0, 1e-30, 0.3, 1.0, 40.0, 1e6, 1e20)),
    light=st.sampled_from(LIGHTS),
)


def is_float(leaf):
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def mask_of(draw, rng, shape):
    if draw.mask == "one pixel":
        mask = np.zeros(shape, bool)
        mask.flat[rng.integers(mask.size)] = True
        return mask
    if draw.mask == "checkerboard":
        return np.indices(shape).sum(axis=0) % 2 == 0
    return {"full": np.ones(shape, bool), "empty": np.zeros(shape, bool), "random": rng.random(shape) < 0.7}[draw.mask]


def normal_of(draw, rng, shape):
    n = unit(rng.normal(size=(*shape, 3)))
    n[..., 2] = np.abs(n[..., 2])
    if draw.normal == "rim":
        n[..., 2] = 0
    elif draw.normal == "away":
        n[..., 2] *= -1
    elif draw.normal == "axis":
        n[:] = (0, 0, 1)
    elif draw.normal == "zero":
        n[:] = 0
    elif draw.normal == "steps":
        n = np.sign(np.round(n * 1.2))
    n = n if draw.normal in ("zero", "steps") else unit(n)
    return n * {"long": 10, "short": 0.1}.get(draw.normal, 1)


def light_of(draw, rng, count=5):
    d = rng.normal(size=(count, 3))
    if draw.light in ("view", "away"):
        d[:, :2] = 0
        d[:, 2] = 1 if draw.light == "view" else -1
    elif draw.light == "horizon":
        d[:, 2] = 0
    elif draw.light == "opposite":
        d[1] = -d[0]
    colour = rng.uniform(0, 1, (count, 3)) * {"dark": 1e-30, "bright": 1e6, "zero": 0}.get(draw.light, 1)
    return se.Lights(unit(d), colour)


def images(draw: Draw, shape, dtype) -> dict:
    """Everything that stage functions read, as NumPy arrays; with `bad` set, bad pixels in every image."""
    rng = np.random.default_rng(draw.seed)
    h, w = shape
    mask = mask_of(draw, rng, shape)
    depth = 3 + np.cumsum(rng.choice([-1, 0, 0, 1], size=shape), axis=1) * draw.depth
    depth = np.where(mask, np.abs(depth) + 1e-3, 0)
    x, y = np.meshgrid(np.arange(w) - w / 2, h / 2 - np.arange(h))
    # d/d alpha is about curvature times radiance while alpha times curvature is small: 1e30 times 1e6 overflows itself
    scale = 10.0 ** (draw.curvature if abs(draw.alpha) >= 1e-3 else min(draw.curvature, 18))
    hessian = scale * rng.normal(size=(*shape, 3)) * rng.choice([0, 1, 1e-7], size=(*shape, 1), p=[0.2, 0.6, 0.2])
    hessian[..., 1] *= rng.choice([0, 1], size=shape)  # some are diagonal, some umbilics
    hessian[rng.random(shape) < 0.2] = scale * np.array([1.0, 0, 1.0])
    weight = lambda: rng.choice([0, 0.3, 1], size=shape)  # noqa: E731
    made = {
        "normal": normal_of(draw, rng, shape),
        "depth": depth,
        "position": np.stack([0.02 * x * depth, 0.02 * y * depth, -depth], -1),
        "albedo": rng.choice([0, 0.5, 1], size=(*shape, 3)),
        "occlusion": weight(),
        "hessian": hessian,
        "gradient": scale**0.3 * rng.normal(size=(*shape, 2)),
        "tensor": scale * rng.normal(size=(*shape, 6)),
        "image": 10.0 ** rng.uniform(-6, 6, (*shape, 3)) * rng.choice([0, 1], size=(*shape, 1), p=[0.2, 0.8]),
        "height": min(scale, 1e6) * rng.normal(size=shape).round(1),
        "direction": unit(rng.normal(size=(*shape, 2)).round()),
        "singularity": weight(),
        "noise": rng.choice([0, 0.5, 1], size=(*shape, 4)),
    }
    if draw.bad is not None:
        where = rng.random(shape) < 0.25
        for name, image in made.items():
            if name != "noise":
                image[where & (rng.random(shape) < 0.6)] = draw.bad
    made = {
        name: np.asarray(np.clip(image, -1e30, 1e30) if draw.bad is None else image, dtype)
        for name, image in made.items()
    }
    return made | {"mask": mask, "silhouette": np.asarray(weight() * mask, dtype)}
