"""What one light gives one pixel: scalar weights of light i at a pixel, for Ashikhmin-Shirley, warped, scaled or plain.

Radiance is linear in the light's colour, so the sum over lights needs a few scalars per pixel and light only:

    A = (1 - (1 - n.l/2)^5) <n.l> j                     diffuse
    B = (n.h)^eta / ((e.h) max(n.l, n.e)) <n.l> j       specular
    C = B (1 - e.h)^5                                   Fresnel's part of it

or, where the specular reflectance R_s has no colour, A and S = R_s B + (1 - R_s) C alone. Here e = z, h is the half
vector and j the solid angle of the warp without its factor det(L^-1). What depends on the pixel alone (reflectances,
constants, det, contrast) stays outside the sum.

A pixel and a light meet in a few *forms*, sums of products of a plane of the pixel and a coefficient of the light
(`terms`); the weights are functions of the forms. So the adjoint of the sum needs one scalar per form, pixel and light.

Arrays broadcast to (block, light, 64 pixels): planes (block, 1, 64), coefficients (block, light, 1).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


class Model(NamedTuple):
    """Which terms the weights have; static."""

    warped: bool = False
    scaled: bool = False
    anisotropic: bool = False
    glossy: bool = True  # without it there is no specular lobe: A alone, and nothing of B and C is computed
    tinted: bool = True  # whether the specular reflectance has a colour; without it S in place of B and C

    @property
    def components(self) -> int:
        return 1 + self.glossy + (self.glossy and self.tinted)


COEFFICIENTS = ("one", "x", "y", "z", "xx", "xy", "yy", "w", "v")


def coefficients(direction):
    """[N, 3] unit directions to the [N, 9] light coefficients of the forms: w = 1 + l_z, and v = (w/2)^-1/2, known once
    per light instead of divided by at every pixel."""
    x, y, z = direction[:, 0], direction[:, 1], direction[:, 2]
    # Without cancellation below the horizon; never 0, so that the light in -z, which no pixel sees, is finite.
    below = z < 0
    w = jnp.where(below, (x * x + y * y) / jnp.where(below, 1 - z, 1), 1 + z)
    w = jnp.maximum(w, 1e-12)
    return jnp.stack([jnp.ones_like(x), x, y, z, x * x, 2 * x * y, y * y, w, lax.rsqrt(0.5 * w)], axis=-1)


def terms(model: Model) -> dict[str, tuple[tuple[str, str], ...]]:
    """The forms: name -> (plane of the pixel, coefficient of the light) pairs."""
    square = ("xx", "xy", "yy")
    table: dict[str, tuple[tuple[str, str], ...]] = {"cos_view": (("nz", "one"),)}
    if model.glossy:
        table["shininess"] = (("shininess", "one"),)
        if not model.tinted:
            table["reflectance"] = (("reflectance", "one"),)
    if model.warped:
        # With T = L^-1 and p' of the light: T p' . n_xy = (T n_xy) . p' and |T p'|^2 = p' . T^2 p'.
        table["tilt"] = (("ux", "x"), ("uy", "y"))
        table["stretch"] = tuple((f"q{s}", s) for s in square)
    else:
        table["cos_light"] = (("nx", "x"), ("ny", "y"), ("nz", "z"))
    if model.scaled:
        table["invariant"] = (("invariant", "one"),)
        if model.anisotropic:
            table |= {name: ((name, "one"),) for name in by_lobe(model, "gamma")}
            table["concave"] = (("concave", "one"),)
            table["mean"] = (("mean", "one"),)
            table["bend"] = tuple((f"r{s}", s) for s in square)
        else:
            table |= {name: ((name, "one"),) for name in by_lobe(model, "gain")}
    return table


def lobes(model: Model) -> tuple[str, ...]:
    return ("diffuse", "specular")[: 1 + model.glossy]


def by_lobe(model: Model, what: str) -> tuple[str, ...]:
    return tuple(f"{what}_{lobe}" for lobe in lobes(model))


def planes_of(model: Model) -> tuple[str, ...]:
    """The planes of a pixel that the weights need, in the order of the plane array."""
    names = ["nx", "ny", "nz"]
    for pairs in terms(model).values():
        names += [plane for plane, _ in pairs if plane not in names]
    return tuple(names)


def forms(model: Model, planes: dict, light: dict) -> dict:
    return {
        name: sum(
            planes[plane] * light[coefficient] if coefficient != "one" else planes[plane]
            for plane, coefficient in pairs
        )
        for name, pairs in terms(model).items()
    }


# ------------------------------------------------------------------------------------------- the Phong power

# Cephes: log(1 + m) - m + m^2/2 as m^3 times a polynomial on [sqrt(1/2) - 1, sqrt(2) - 1], and 2^f on [-1/2, 1/2].
_LOG = (7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1, -1.6668057665e-1,
        2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1)  # fmt: skip
_EXP = (1.535336188319500e-4, 1.339887440266574e-3, 9.618437357674640e-3, 5.550332471162809e-2, 2.402264791363012e-1,
        6.931472028550421e-1, 1.0)  # fmt: skip


def _horner(polynomial, x):
    total = jnp.full_like(x, polynomial[0])
    for a in polynomial[1:]:
        total = total * x + a
    return total


def logarithm(x):
    """log(x) for normal x > 0. In float32 a quarter faster than the library's, which also treats 0, inf and NaN."""
    if x.dtype != np.float32:
        return jnp.log(x)
    bits = lax.bitcast_convert_type(x, jnp.int32)
    exponent = (bits - 0x3F3504F3) >> 23  # so that the mantissa lies around 1
    m = lax.bitcast_convert_type(bits - (exponent << 23), jnp.float32) - 1
    square = m * m
    return (m + square * (m * _horner(_LOG, m) - 0.5)) + exponent.astype(jnp.float32) * np.log(2).astype(np.float32)


def exponential(x):
    """exp(x) for x <= 0; not below the least normal number."""
    if x.dtype != np.float32:
        return jnp.exp(x)
    y = jnp.maximum(x * np.float32(1 / np.log(2)), -126)
    whole = jnp.floor(y + 0.5)
    bits = (whole.astype(jnp.int32) + 127) << 23
    return _horner(_EXP, y - whole) * lax.bitcast_convert_type(bits, jnp.float32)


# ------------------------------------------------------------------------------------------- the weights


def _fourth(x):
    square = x * x
    return square * square


def _fifth(x):
    return _fourth(x) * x


def reciprocal_root(x):
    """x^-1/2 of normal x > 0. In float32 by Newton's method from a guess of its bits, to 1 ulp: root and quotient take
    longer, and the processors' own guess differs from one width of registers to the next."""
    if x.dtype != np.float32:
        return jnp.sqrt(1 / x)
    y = lax.bitcast_convert_type(0x5F375A86 - (lax.bitcast_convert_type(x, jnp.int32) >> 1), jnp.float32)
    for _ in range(3):
        y = y + y * (0.5 - 0.5 * x * y * y)
    return y


def gain(exponent):
    """exp(gamma kappa), held where products of it and of its inverse stay finite: sigma is at its limit there."""
    bound = 0.3 * np.log(np.finfo(exponent.dtype).max)
    return jnp.exp(jnp.clip(exponent, -bound, bound))


def scaling(gain, delta, invariant):
    """sigma of SPEC 6 with gain E = exp(gamma kappa): (A E + B)/(A + B E), A = a (1 - delta), B = (1 - a) delta."""
    a, b = invariant * (1 - delta), (1 - invariant) * delta
    return (a * gain + b) / (a + b * gain)


class Meeting(NamedTuple):
    """Cosines of a pixel and a light: n.l (0 where either partner of the light is behind the surface), e.h, n.h; j."""

    cos_light: jax.Array
    half_view: jax.Array
    inverse: jax.Array  # 1/(e.h)
    cos_half: jax.Array
    j: jax.Array
    square: jax.Array  # t^2 = 1/(w^2 + |T p'|^2)


def root(form: dict, light: dict):
    """t = (w^2 + |T p'|^2)^-1/2, of warped models: part of the forms for what follows."""
    return reciprocal_root(light["w"] * light["w"] + form["stretch"])


def warped_cosine(form: dict, light: dict):
    """n.l of warped models."""
    w = light["w"]
    cos_light = form["root"] ** 2 * (2 * w * form["tilt"] + form["cos_view"] * (w * w - form["stretch"]))
    return jnp.where((cos_light > 0) & (form["facing"] > 0), cos_light, 0)


def meet(model: Model, form: dict, light: dict) -> Meeting:
    """The geometry of `weights`."""
    cos_view, w, v = form["cos_view"], light["w"], light["v"]
    tiny = np.finfo(cos_view.dtype).tiny ** 0.25
    if model.warped:
        t = form["root"]
        square = t * t
        cos_light = form["cos_light"]
        half_view, inverse = w * t, (0.5 * v * v) * ((w * w + form["stretch"]) * t)
        q = 2 * w * square
        j = q * q
    else:
        cos_light = jnp.maximum(form["cos_light"], 0)
        square = j = jnp.ones_like(w)
        half_view, inverse = 0.5 * w * v, v
    # h = (l + e)/|l + e| and |l + e| = 2 e.h, so n.h = (n.l + n.e)/(2 e.h).
    cos_half = jnp.maximum(0.5 * (cos_light + cos_view) * inverse, tiny)
    return Meeting(cos_light, half_view, inverse, cos_half, j, square)


def diffuse(model: Model, form: dict, light: dict):
    """A of the module's docstring; of anisotropic models the forms contain the curvature and the gains."""
    at = meet(model, form, light)
    lobe = (1 - _fifth(1 - 0.5 * at.cos_light)) * (at.cos_light * at.j)
    if not model.scaled:
        return lobe
    return lobe * scaling(form["gain_diffuse"], jnp.minimum(at.cos_light, 1), form["invariant"])


def specular(model: Model, form: dict, light: dict):
    """B of the module's docstring; the forms contain log(n.h), and the gains as in `diffuse`."""
    at = meet(model, form, light)
    log = form["log"]
    tiny = np.finfo(log.dtype).tiny ** 0.25
    # The larger cosine is at least n.e; at n.e = 0 an unlit pixel would divide 0 by 0.
    top = jnp.maximum(jnp.maximum(at.cos_light, form["cos_view"]), tiny)
    lobe = exponential(jnp.minimum(form["shininess"] * log, 0)) * (at.cos_light * at.j) * at.inverse / top
    if not model.scaled:
        return lobe
    return lobe * scaling(form["gain_specular"], jnp.minimum(at.cos_half, 1), form["invariant"])


def reflected(model: Model, form: dict, light: dict):
    """C, or S, of the module's docstring; the forms contain B as "specular"."""
    fifth = _fifth(1 - meet(model, form, light).half_view)
    return form["specular"] * (fifth if model.tinted else form["reflectance"] * (1 - fifth) + fifth)


def reflected_at_once(model: Model, form: dict, light: dict):
    """`reflected` where B itself is not needed."""
    return reflected(model, form | {"specular": specular(model, form, light)}, light)


def curvature(model: Model, form: dict, light: dict):
    """tanh of the curvature that the direction of the light sees, of anisotropic models."""
    return jnp.tanh(form["mean"] + form["bend"] * meet(model, form, light).j)


def weighed(form: dict):
    """The curvature, where it is concave times its own strength."""
    return jnp.where(form["curvature"] > 0, form["concave"] * form["curvature"], form["curvature"])


def anisotropic_gain(lobe: str, form: dict, light: dict):
    """E of a lobe, which depends on the light through the curvature that it sees."""
    return gain(form[f"gamma_{lobe}"] * weighed(form))


# ------------------------------------------------------------------------------------------- their derivatives


def _scaling_slopes(gain, delta, invariant):
    """Derivatives of log sigma with respect to log E, delta and a: with A and B of `scaling`,

    d log sigma = [E (A^2 - B^2) d log E + (1 - E^2) (a (1 - a) d delta - delta (1 - delta) d a)] / ((A E + B)(A + B E))
    """
    a, b = invariant * (1 - delta), (1 - invariant) * delta
    over = 1 / ((a * gain + b) * (a + b * gain))
    bent = (1 - gain) * (1 + gain) * over
    return (
        gain * (a - b) * (a + b) * over,
        bent * (invariant * (1 - invariant)),
        -bent * (delta * (1 - delta)),
    )


def adjoint(model: Model, form: dict, light: dict, along):
    """Cotangents of the forms and of w, from those of the weights, `along`; the forms contain A and B.

    By logarithmic derivatives: B is there already, and with P = (B' + C' (1 - e.h)^5) B, primes marking cotangents,

        d log B = eta d log n.h + (d log n.l where n.l < n.e, else -d log n.e) - d log e.h + d log j
        d log n.h = (d n.l + d n.e)/(n.l + n.e) - d log e.h

    and j = 4 w^2 t^4, e.h = w t, n.l = t^2 (2 w d + n.e (w^2 - s)), t^-2 = w^2 + s for tilt d and stretch s. For an
    unlit pixel every term is 0 by a factor of n.l.
    """
    at = meet(model, form, light)
    cos_light, cos_view, w = at.cos_light, form["cos_view"], light["w"]
    nothing = jnp.zeros_like(cos_view)
    bar = {}

    # The diffuse lobe: the slope of A over n.l at fixed j and sigma.
    along_diffuse = along[0]
    whole = along_diffuse * form["diffuse"]
    x = 1 - 0.5 * cos_light
    fourth = _fourth(x)
    slope = (1 - fourth * x + 2.5 * cos_light * fourth) * at.j
    if model.scaled:
        clamped = jnp.minimum(cos_light, 1)
        slope = slope * scaling(form["gain_diffuse"], clamped, form["invariant"])
        by_gain, by_delta, by_invariant = _scaling_slopes(form["gain_diffuse"], clamped, form["invariant"])
        gain_bar, bar["invariant"] = whole * by_gain, whole * by_invariant  # of log E, and of a
    light_bar = along_diffuse * slope + (whole * by_delta if model.scaled else 0)
    view_bar = log_half_view = nothing
    log_j = whole

    # The specular lobe.
    if model.glossy:
        tiny = np.finfo(cos_view.dtype).tiny ** 0.25
        rest = 1 - at.half_view
        if model.tinted:
            along_specular, along_fresnel = along[1], along[2]
        else:
            along_specular, along_fresnel = along[1] * form["reflectance"], along[1] * (1 - form["reflectance"])
            bar["reflectance"] = along[1] * form["specular"] * (1 - _fifth(rest))
        peak = (along_specular + along_fresnel * _fifth(rest)) * form["specular"]
        bar["shininess"] = peak * form["log"]
        half_slope = form["shininess"]  # d log B / d log n.h
        if model.scaled:
            clamped = jnp.minimum(at.cos_half, 1)
            by_gain, by_delta, by_invariant = _scaling_slopes(form["gain_specular"], clamped, form["invariant"])
            half_gain_bar, bar["invariant"] = peak * by_gain, bar["invariant"] + peak * by_invariant
            half_slope = half_slope + by_delta * jnp.where(at.cos_half < 1, at.cos_half, 0)
        # One quotient serves 1/(n.l + n.e) and 1/n.l.
        safe = jnp.maximum(cos_light, tiny)
        both = safe + cos_view
        quotient = peak / (safe * both)
        by_half = quotient * safe * half_slope
        grazing = cos_light < cos_view
        light_bar = light_bar + by_half + jnp.where(grazing, quotient * both, 0)
        view_bar = by_half - jnp.where(grazing, peak / jnp.maximum(cos_view, tiny), 0)
        log_half_view = -(half_slope + 1) * peak - 5 * along_fresnel * form["specular"] * _fourth(rest) * at.half_view
        log_j = log_j + peak

    # The gains E, whose curvature may see the light.
    if model.scaled and model.anisotropic:
        plain, kappa = form["curvature"], weighed(form)
        bar["gamma_diffuse"] = gain_bar * kappa
        inner = gain_bar * form["gamma_diffuse"]
        if model.glossy:
            bar["gamma_specular"] = half_gain_bar * kappa
            inner = inner + half_gain_bar * form["gamma_specular"]
        bar["concave"] = jnp.where(plain > 0, inner * plain, 0)
        inner = inner * jnp.where(plain > 0, form["concave"], 1) * (1 - plain * plain)
        bar["mean"], bar["bend"] = inner, inner * at.j
        log_j = log_j + inner * form["bend"] * at.j
    elif model.scaled:
        bar["gain_diffuse"] = gain_bar / form["gain_diffuse"]
        if model.glossy:
            bar["gain_specular"] = half_gain_bar / form["gain_specular"]

    # The geometry.
    if not model.warped:
        bar["cos_light"], bar["cos_view"] = light_bar, view_bar
        return bar, 0.25 * log_half_view * light["v"] ** 2
    log_t = log_half_view + 4 * log_j + 2 * cos_light * light_bar
    stretch = form["stretch"]
    bar["tilt"] = 2 * w * at.square * light_bar
    bar["stretch"] = -at.square * (cos_view * light_bar + 0.5 * log_t)
    bar["cos_view"] = view_bar + (w * w - stretch) * at.square * light_bar
    w_bar = at.square * (2 * light_bar * (form["tilt"] + cos_view * w) - w * log_t)
    w_bar = w_bar + 0.5 * (log_half_view + 2 * log_j) * light["v"] ** 2
    return bar, w_bar
