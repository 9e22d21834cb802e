"""Reflected radiance: the sums over lights, plain, warped and scaled (SPEC 5, 6, 7; LW09 eq. 2 and 3; TH10 5.3)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks
from shapeenh.fusion import stored
from shapeenh.light import brdf, sums, warp
from shapeenh.light.scaling import check_strengths
from shapeenh.light.weights import Model, by_lobe, gain
from shapeenh.types import Descriptor, GBuffer
from shapeenh.wide import jit_wide

# ------------------------------------------------------------------------------------------- what a pixel brings
# A prologue turns inputs, planes (block, channel, 64) by name, into the planes of the weights and the factors that stay
# outside the sum; an epilogue applies the factors. Both are differentiated by JAX.


def _prologue(model: Model, inputs, on):
    normal = inputs["normal"]
    # A visible surface faces the viewer, but interpolated normals overshoot at the limb. There every reflectance is 0,
    # and a black rim would result; with |n_z| the limb continues the shading of the pixels before it.
    nx, ny, nz = normal[:, 0], normal[:, 1], jnp.abs(normal[:, 2])
    planes = {"nx": nx, "ny": ny, "nz": nz}

    factor = jnp.ones_like(nz)
    if model.warped or model.scaled:
        hessian = inputs["hessian"]
        xx, xy, yy = hessian[:, 0], hessian[:, 1], hessian[:, 2]
        concave = inputs["concave"][:, 0]
    if model.warped:
        alpha = inputs["alpha"][:, 0]
        a, b, c = stored(on, _inverse_tensor, xx, xy, yy, -alpha, -alpha * concave)
        planes |= {"ux": a * nx + b * ny, "uy": b * nx + c * ny}
        planes |= {"qxx": a * a + b * b, "qxy": b * (a + c), "qyy": b * b + c * c}
        det = a * c - b * b
        factor = det * jnp.exp(-inputs["contrast"][:, 0] * jnp.log(det))  # J's factor, and eq. 3
    if model.scaled:
        strengths = {name: inputs[name][:, 0] for name in by_lobe(model, "gamma")}
        mean, half = 0.5 * xx + 0.5 * yy, 0.5 * xx - 0.5 * yy
        # Off the mask inputs are 0, and sigma would be 0/0 there.
        planes["invariant"] = jnp.where(inputs["invariant"][:, 0] > 0, inputs["invariant"][:, 0], 0.5)
        if model.anisotropic:
            anisotropy = inputs["anisotropy"][:, 0]
            rxx, rxy, ryy = half, xy, -half
            if model.warped:  # l_xy = sqrt(j) T p', so T goes around the deviator of the Hessian
                rxx, rxy, ryy = (
                    a * (a * half + b * xy) + b * (a * xy - b * half),
                    b * (a * half + b * xy) + c * (a * xy - b * half),
                    b * (b * half + c * xy) + c * (b * xy - c * half),
                )
            planes |= {"mean": mean, "concave": concave} | strengths
            planes |= {"rxx": anisotropy * rxx, "rxy": anisotropy * rxy, "ryy": anisotropy * ryy}
        else:
            kappa = jnp.tanh(mean)
            kappa = jnp.where(kappa > 0, concave * kappa, kappa)
            planes |= {f"gain_{name[6:]}": gain(strength * kappa) for name, strength in strengths.items()}

    diffuse = inputs["diffuse"]
    if "albedo" in inputs:
        diffuse = diffuse * inputs["albedo"]
    facing = brdf.DIFFUSE * (1 - (1 - 0.5 * nz) ** 5) * factor
    diffuse = diffuse * _to_channels(facing)
    if not model.glossy:
        return planes, (diffuse,)
    specular, shininess = inputs["specular"], inputs["shininess"][:, 0]
    planes["shininess"] = shininess
    peak = (shininess + 1) / (8 * np.pi) * factor
    if not model.tinted:
        planes["reflectance"] = specular[:, 0]
        return planes, (diffuse * _to_channels(1 - specular[:, 0]), peak)
    return planes, (diffuse * (1 - specular), specular * _to_channels(peak), (1 - specular) * _to_channels(peak))


@jax.custom_vjp
def _to_channels(plane):
    """(block, 64) as (block, 3, 64). In reverse mode the channels are added one by one: XLA on CPU hands a sum along a
    short axis to a library, and waits for it."""
    return jnp.broadcast_to(plane[:, None], (plane.shape[0], 3, plane.shape[1]))


_to_channels.defvjp(lambda plane: (_to_channels(plane), None), lambda _, bar: (bar[:, 0] + bar[:, 1] + bar[:, 2],))


def _inverse_tensor(xx, xy, yy, convex, concave):
    tensor = warp.spectral(jnp.stack([xx, xy, yy], axis=-1), convex, concave)
    return tensor[..., 0], tensor[..., 1], tensor[..., 2]


def _epilogue(totals, factors):
    factors = (_to_channels(factor) if factor.ndim == 2 else factor for factor in factors)
    return sum(total * factor for total, factor in zip(totals, factors, strict=True))


def _reach(model: Model) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Which planes of the weights each input of the prologue moves."""
    tensor = ("ux", "uy", "qxx", "qxy", "qyy") if model.warped else ()
    bend = ("rxx", "rxy", "ryy") if model.anisotropic else ()
    table = {"normal": ("nx", "ny", "nz", *tensor[:2])}
    if model.glossy:
        table["shininess"] = ("shininess",)
        if not model.tinted:
            table["specular"] = ("reflectance",)
    if model.warped:
        table |= {"alpha": (*tensor, *bend)}
    if model.scaled and model.anisotropic:
        table |= {"anisotropy": bend, "concave": (*tensor, *bend, "concave"), "hessian": (*tensor, *bend, "mean")}
        table |= {name: (name,) for name in by_lobe(model, "gamma")}
    elif model.scaled:
        gains = by_lobe(model, "gain")
        table |= {"concave": (*tensor, *gains), "hessian": (*tensor, *gains)}
        table |= {f"gamma_{name[5:]}": (name,) for name in gains}
    else:
        table |= {"concave": tensor, "hessian": tensor}
    if model.scaled:
        table["invariant"] = ("invariant",)
    return tuple(table.items())


# ------------------------------------------------------------------------------------------- the Python layer


@functools.partial(jit_wide, static_argnames=("plan",))
def _shade_image(plan, mask, inputs, direction, radiance, count):
    return sums.shade_image(plan, mask, inputs, direction, radiance, count)


def _shade(model: Model, gbuffer, lights, material, options: dict):
    """Common to all: checks, skips what the scene does not need, and calls the compiled sum."""
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_shape("gbuffer.normal", gbuffer.normal, (None, None, 3))
    size = np.shape(gbuffer.normal)[:2]
    checks.check_shape("gbuffer.mask", gbuffer.mask, size)
    brdf.check_lights(lights)
    brdf.check_material(material)

    dtype = checks.float_dtype(gbuffer.normal)
    inputs = {"normal": jnp.asarray(gbuffer.normal, dtype)}
    if gbuffer.albedo is not None:
        checks.check_shape("gbuffer.albedo", gbuffer.albedo, (*size, 3))
        inputs["albedo"] = jnp.asarray(gbuffer.albedo, dtype)
    inputs["diffuse"] = _input("material.diffuse", material.diffuse, size, 3, dtype)
    if material.specular is None:
        model = model._replace(glossy=False)
        options = {name: value for name, value in options.items() if name != "gamma_specular"}
    else:
        specular, tinted = _grey_if_known(material.specular, size)
        model = model._replace(tinted=tinted)
        inputs["specular"] = _input("material.specular", specular, size, 3 if tinted else 1, dtype)
        inputs["shininess"] = _input("material.shininess", material.shininess, size, 1, dtype)
    for name, value in options.items():
        inputs[name] = jnp.asarray(value, dtype) if name == "hessian" else _input(name, value, size, 1, dtype)

    direction, radiance, count = _prepared_lights(lights, dtype)
    plan = sums.Plan(model, _prologue, _epilogue, _reach(model), *_steps())
    return _shade_image(plan, jnp.asarray(gbuffer.mask, bool), inputs, direction, radiance, count)


def _grey_if_known(specular, size):
    """(The specular reflectance, whether it has a colour): without one, a sum over lights less is needed."""
    if np.shape(specular) in ((), size):
        return specular, False
    if np.shape(specular) == (3,) and checks.is_concrete(specular) and len(set(np.asarray(specular).tolist())) == 1:
        return np.asarray(specular)[0], False
    return specular, True


def _input(name, value, size, channels, dtype):
    """A number or [channels] as a constant [channels]; a map [H, W] or [H, W, channels] as an image."""
    shape = np.shape(value)
    if shape in ((), (channels,)):
        constant = checks.as_number(value, dtype)
        return np.full((channels,), constant) if checks.is_concrete(value) else jnp.broadcast_to(constant, (channels,))
    if shape in (size, (*size, channels)):
        return jnp.broadcast_to(jnp.asarray(value, dtype).reshape(*size, -1), (*size, channels))
    text = "[]" if channels == 1 else f"[], [{channels}]"
    raise ValueError(f"{name} has shape {shape}; accepted is {text} or a map of {size[0]} x {size[1]} pixels")


def _steps() -> tuple[int, int]:
    """Blocks and lights per step: what stays in a CPU's cache and is yet worth sharing among its cores, or what fills
    an accelerator."""
    return (512, 8) if jax.default_backend() == "cpu" else (4096, 16)


def _prepared_lights(lights, dtype):
    """Directions and colours, padded to one of few sizes, and how many shine: other numbers compile nothing."""
    direction, radiance = lights.direction, lights.radiance
    known = checks.is_concrete(lights)
    if known:
        direction, radiance = np.asarray(direction), np.asarray(radiance)
        shining = np.any(radiance != 0, axis=-1)
        direction, radiance = direction[shining], radiance[shining]
    count = direction.shape[0]
    extra = sums.ladder(count, 8) - count
    numpy = np if known else jnp
    direction = numpy.concatenate([direction, numpy.broadcast_to(numpy.asarray([0.0, 0.0, 1.0]), (extra, 3))])
    radiance = numpy.concatenate([radiance, numpy.zeros((extra, 3))])
    return numpy.asarray(direction, dtype), numpy.asarray(radiance, dtype), np.int32(count)


def _check_descriptor(descriptor, gbuffer):
    checks.check_type("gbuffer", gbuffer, GBuffer)
    checks.check_type("descriptor", descriptor, Descriptor)
    checks.check_shape("descriptor.hessian", descriptor.hessian, np.shape(gbuffer.normal))


# ------------------------------------------------------------------------------------------- the public functions


def shade(gbuffer, lights, material):
    """Radiance reflected towards the viewer by Ashikhmin-Shirley under directional lights.

    Source: SPEC 7; `sum over i of rho(z, l_i) <n.l_i> L_i`.
    gbuffer: `GBuffer`; `albedo`, where there is one, multiplies the diffuse reflectance. lights: `Lights` in the frame
    of the normals (camera space). material: `Material`; each field may also be a map [H, W] or [H, W, 3].
    Returns [H, W, 3], linear radiance, >= 0; 0 off the mask and where an input is not finite. At the limb, where
    interpolated normals turn away from the viewer, |n_z| is used.
    Gradient: exact in normals, albedo, lights (directions: along the sphere) and material; memory does not grow with
    the number of lights. Errors: ValueError for wrong records, shapes, values.
    """
    return _shade(Model(), gbuffer, lights, material, {})


def shade_warped(gbuffer, descriptor, lights, material, *, alpha, gamma=0.0, concave=1.0):
    """Radiance reflected towards the viewer with the light bent by the surface's curvature.

    Source: LW09 eq. 2 and 3; SPEC 5, inverse form: `det(L)^gamma sum rho(z, l_i) <n.l_i> L_i J`, l_i = W^-1(l'_i).
    gbuffer, lights, material: as in `shade`. descriptor: `Descriptor`; its `hessian` is used.
    alpha: [] or a map [H, W], px, any finite value: strength; 0 = no warp. gamma: [] or [H, W], in [-1, 1]: contrast;
    0 = none. concave: [] or [H, W]: the strength of concavities (positive curvatures) relative to convexities.
    Returns [H, W, 3], linear radiance, >= 0; 0 off the mask. `alpha = 0` gives `shade` up to rounding, and is as fast.
    Gradient: exact in alpha, gamma, concave, hessian, normals, albedo, lights and material.
    Errors: ValueError for wrong records, shapes, values.
    """
    _check_descriptor(descriptor, gbuffer)
    checks.check_finite("alpha", alpha)
    checks.check_range("gamma", gamma, -1, 1)
    checks.check_finite("concave", concave)
    if checks.is_zero(alpha):
        return shade(gbuffer, lights, material)
    options = {"hessian": descriptor.hessian, "alpha": alpha, "contrast": gamma, "concave": concave}
    return _shade(Model(warped=True), gbuffer, lights, material, options)


def shade_scaled(
    gbuffer,
    descriptor,
    lights,
    material,
    *,
    invariant,
    gamma_diffuse,
    gamma_specular,
    anisotropy=0.0,
    concave=1.0,
    alpha=0.0,
    contrast=0.0,
):
    """Radiance reflected towards the viewer, each light's share made brighter or darker by the surface's curvature.

    Source: TH10 5.3; SPEC 6: `sum rho <n.l_i> sigma(kappa(p, l_i), delta) L_i`, delta = n.l for the diffuse, n.h for
    the specular component. With `alpha` both ways at once (TH10 fig. 5.26): the lights are warped, kappa and delta
    taken at the unwarped directions.
    gbuffer, lights, material, descriptor: as in `shade_warped`.
    invariant: [] or [H, W], in ]0, 1[: the level that is left alone. gamma_diffuse, gamma_specular: [] or [H, W], >= 0:
    strengths; 0 = none. anisotropy: [] or [H, W], in [-1, 1]. concave: [] or [H, W]: strength of concavities relative
    to convexities. alpha, contrast: the warp's strength, px, and its exponent in [-1, 1].
    Returns [H, W, 3], linear radiance, >= 0; 0 off the mask. Strengths of 0 give `shade` up to rounding, and are as
    fast.
    Gradient: exact in all strengths, hessian, normals, albedo, lights and material.
    Errors: ValueError for wrong records, shapes, values.
    """
    _check_descriptor(descriptor, gbuffer)
    looks = {"alpha": alpha, "contrast": contrast, "invariant": invariant, "anisotropy": anisotropy}
    check_strengths(**looks, concave=concave, gamma_diffuse=gamma_diffuse, gamma_specular=gamma_specular)
    warped = not checks.is_zero(alpha)
    if checks.is_zero(gamma_diffuse, gamma_specular):
        return shade_warped(gbuffer, descriptor, lights, material, alpha=alpha, gamma=contrast, concave=concave)
    model = Model(warped=warped, scaled=True, anisotropic=not checks.is_zero(anisotropy))
    options = {"hessian": descriptor.hessian, "concave": concave, "invariant": invariant}
    options |= {"gamma_diffuse": gamma_diffuse, "gamma_specular": gamma_specular}
    if model.anisotropic:
        options["anisotropy"] = anisotropy
    if warped:
        options |= {"alpha": alpha, "contrast": contrast}
    return _shade(model, gbuffer, lights, material, options)
