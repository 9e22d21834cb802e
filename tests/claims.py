"""What every public function says about its gradient, as a table: one `Claim` per function and variant.

`values(scene)` are the arguments in which it is differentiable, `call(scene, values)` what it makes of them. A value
may be any array that the call brings into the right form first, such as lights by `unit`, along the sphere.
`test_claims.py` holds every claim on every scene; `docs/gradients.md` says the same in words.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

import shapeenh as se
from shapeenh.numerics import normalize as unit
from shapeenh.types import replace
from tests.scenes import SIZE, Scene

H, W = SIZE


@dataclass(frozen=True)
class Claim:
    name: str
    call: Callable[[Scene, dict], object]
    values: Callable[[Scene], dict]
    variant: str = ""
    slow: bool = False  # compiles for more than about 5 s

    @property
    def id(self) -> str:
        return f"{self.name}-{self.variant}" if self.variant else self.name


CLAIMS: list[Claim] = []


def claim(name, call, values, *, variant="", slow=False):
    CLAIMS.append(Claim(name, call, values, variant, slow))


# ------------------------------------------------------------------------------------------- parts of scenes


def fields(record, values, *names):
    """The record with those of its fields changed that `values` holds."""
    return replace(record, **named(values, *names))


def towards(direction, z):
    """Directions turned towards the viewer."""
    return direction.at[..., 2].add(z)


def named(values, *names):
    return {name: values[name] for name in names if name in values}


def gbuffer(s, v):
    return fields(s.gbuffer, v, "depth", "normal", "position", "albedo", "occlusion", "uv")


def plain(s, v):
    """A G-buffer without the optional fields."""
    return replace(gbuffer(s, v), albedo=None, occlusion=None, uv=None)


def descriptor(s, v):
    return fields(s.descriptor, v, "hessian", "gradient", "silhouette", "crease", "conductance")


def mesh(s, v):
    return fields(s.mesh, v, "vertices", "normals", "colors", "uv")


def camera(s, v):
    return fields(s.camera, v, "view", "projection")


def lights(s, v):
    return se.Lights(unit(v.get("light", s.lights.direction)), v.get("radiance", s.lights.radiance))


def material(v):
    return se.Material(
        v.get("diffuse", jnp.full(3, 0.6)), v.get("specular", jnp.full(3, 0.1)), v.get("shininess", 12.0)
    )


def pick(record, *names):
    return lambda s: {name: getattr(getattr(s, record), name) for name in names}


def also(first, **numbers):
    """The values of `first`, and plain numbers."""
    return lambda s: first(s) | {name: jnp.asarray(x, jnp.float64) for name, x in numbers.items()}


def only(**numbers):
    return also(lambda s: {}, **numbers)


NORMAL = pick("gbuffer", "normal")
HESSIAN = pick("descriptor", "hessian")
GEOMETRY = lambda s: pick("mesh", "vertices", "normals")(s) | pick("camera", "view", "projection")(s)  # noqa: E731
LIGHTS = lambda s: {"light": s.lights.direction, "radiance": s.lights.radiance}  # noqa: E731
MATERIAL = only(diffuse=[0.6, 0.5, 0.4], specular=[0.1, 0.2, 0.15], shininess=12.0)
TEXTURE = lambda s: {"texels": s.texture}  # noqa: E731
IMAGE = lambda s: {"image": s.image}  # noqa: E731


def join(*parts):
    return lambda s: {name: value for part in parts for name, value in part(s).items()}


# ------------------------------------------------------------------------------------------- scene

for _name, _options in (
    ("perspective_camera", {"fov_degrees": 35.0, "near": 0.01}),
    ("orthographic_camera", {"height": 2.0}),
):
    claim(
        _name,
        lambda s, v, name=_name: getattr(se, name)(v.pop("eye"), v.pop("target"), **v),
        only(eye=[0.4, 1.0, 3.0], target=[0.1, -0.2, 0.3], up=[0.1, 1.0, 0.2], aspect=1.3, **_options),
    )
claim(
    "frame_mesh",
    lambda s, v: se.frame_mesh(
        mesh(s, v), direction=v["direction"], up=v["up"], fov_degrees=v["fov"], aspect=v["aspect"]
    ),
    also(pick("mesh", "vertices"), direction=[0.5, 0.4, 1.0], up=[0.1, 1.0, 0.0], fov=33.0, aspect=1.3),
)
claim(
    "rotate_lights",
    lambda s, v: se.rotate_lights(se.Lights(v["direction"], s.lights.radiance), camera(s, v)).direction,
    join(pick("lights", "direction"), pick("camera", "view")),
)
claim(
    "make_mesh",
    lambda s, v: [(m := se.make_mesh(v["vertices"], s.mesh.faces)).vertices, m.normals],
    pick("mesh", "vertices"),
)
claim(
    "make_mesh",
    lambda s, v: [(m := se.make_mesh(s.mesh.vertices, s.mesh.faces, **v)).normals, m.colors, m.uv],
    pick("mesh", "normals", "colors", "uv"),
    variant="attributes",
)
claim("vertex_normals", lambda s, v: se.vertex_normals(v["vertices"], s.mesh.faces), pick("mesh", "vertices"))
claim("vertex_curvature", lambda s, v: se.vertex_curvature(mesh(s, v)), pick("mesh", "vertices", "normals"))
claim(
    "pad_mesh",
    lambda s, v: jax.tree.leaves(replace(se.pad_mesh(mesh(s, v), vertices=256), faces=None)),
    pick("mesh", "vertices", "normals", "colors", "uv"),
)
claim(
    "sample_environment",
    lambda s, v: se.sample_environment(jnp.exp(v["log_map"]), 7, rotation=v["rotation"]),
    also(lambda s: {"log_map": jnp.log(s.map)}, rotation=[[0.6, 0.8, 0.1], [-0.8, 0.6, 0.0], [0.0, 0.1, 1.0]]),
)
claim(
    "sample_environment",
    lambda s, v: se.sample_environment(s.map, 7, rotation=v["angle"]),
    only(angle=0.7),
    variant="angle",
)

# ------------------------------------------------------------------------------------------- buffers

claim(
    "interpolate",
    lambda s, v: se.interpolate(v["attribute"], mesh(s, v), camera(s, v), s.seen),
    lambda s: {"attribute": s.mesh.colors} | pick("mesh", "vertices")(s) | pick("camera", "view", "projection")(s),
)
claim(
    "barycentrics",
    lambda s, v: se.barycentrics(mesh(s, v), camera(s, v), s.seen),
    join(pick("mesh", "vertices"), pick("camera", "view", "projection")),
)
claim(
    "render_gbuffer",
    lambda s, v: replace(se.render_gbuffer(mesh(s, v), camera(s, v), height=H, width=W, uv=True), mask=None),
    join(GEOMETRY, pick("mesh", "colors", "uv")),
    slow=True,
)
claim("resolve_coverage", lambda s, v: se.resolve_coverage(v["image"], s.coverage), IMAGE)


def mapped(space):
    return lambda s, v: (
        se.apply_normal_map(
            s.gbuffer,
            mesh(s, v),
            camera(s, v),
            s.seen,
            v["texels"] - 0.3,
            space=space,
            check=False,
            **named(v, "strength"),
        ).normal
    )


claim(
    "apply_normal_map",
    mapped("tangent"),
    also(join(GEOMETRY, pick("mesh", "uv"), TEXTURE), strength=0.8),
    variant="tangent",
)
claim(
    "apply_normal_map",
    mapped("object"),
    join(TEXTURE, pick("mesh", "uv"), pick("camera", "view")),
    variant="object",
    slow=True,
)
claim(
    "apply_texture",
    lambda s, v: se.apply_texture(gbuffer(s, v), v["texture"]).albedo,
    lambda s: {"texture": s.texture, "uv": s.gbuffer.uv},
)
claim(
    "sample_texture",
    lambda s, v: se.sample_texture(v["texture"], v["uv"]),
    lambda s: {"texture": s.texture, "uv": 3 * s.direction[..., :2]},
)
claim(
    "decode_normals",
    lambda s, v: se.decode_normals(v["colours"], green="down"),
    lambda s: {"colours": 0.5 + 0.4 * s.direction},
)
claim(
    "gbuffer_from_normals",
    lambda s, v: replace(se.gbuffer_from_normals(**v, check=False), mask=None),
    also(
        lambda s: {
            "normal": jnp.where(s.gbuffer.mask[..., None], towards(s.gbuffer.normal, 0.05), 0),  # above the hold
            "depth": jnp.where(s.gbuffer.mask, s.gbuffer.depth, 1.5),
            "occlusion": s.noise[..., 0],
            "albedo": s.noise[..., 1:],
        },
        spacing=[0.9, 1.1],
    ),
)


def _relief(s, v):
    """Without the plane that depth is measured from."""
    g = se.gbuffer_from_height(**v, mask=s.gbuffer.mask)
    nearest = jnp.min(jnp.where(g.mask, g.depth, jnp.inf))
    return g.normal, jnp.where(g.mask, g.depth - nearest, 0), g.position[..., :2], g.albedo, g.occlusion


claim(
    "gbuffer_from_height",
    _relief,
    also(
        lambda s: {"height": s.field.height, "occlusion": s.noise[..., 0], "albedo": s.noise[..., 1:]},
        spacing=[0.9, 1.1],
        z_factor=0.7,
    ),
)
claim(
    "gbuffer_from_points",
    lambda s, v: replace(
        se.gbuffer_from_points(
            v["points"],
            v["normals"],
            v["radius"],
            camera(s, v),
            height=H,
            width=W,
            colors=v["colors"],
            tolerance=v["tolerance"],
        ),
        mask=None,
    ),
    also(
        join(
            lambda s: {"points": s.points, "normals": s.normals, "colors": s.mesh.colors[: len(s.points)]},
            lambda s: {"radius": jnp.linspace(0.2, 0.3, len(s.points))},
            pick("camera", "view", "projection"),
        ),
        tolerance=1.1,
    ),
    slow=True,
)

# ------------------------------------------------------------------------------------------- descriptor

claim("mean_curvature", lambda s, v: se.mean_curvature(**v), HESSIAN)
claim("gaussian_curvature", lambda s, v: se.gaussian_curvature(**v), HESSIAN)
claim("principal_curvatures", lambda s, v: se.principal_curvatures(**v), HESSIAN)
claim("principal_directions", lambda s, v: se.principal_directions(**v), HESSIAN)
claim(
    "curvature_colors",
    lambda s, v: se.curvature_colors(descriptor(s, v), s.gbuffer.mask, scale=0.08),
    pick("descriptor", "hessian", "silhouette", "crease"),
)
claim(
    "curvature_intensity",
    lambda s, v: se.curvature_intensity(v["x"], beta=v["beta"]),
    also(lambda s: {"x": s.noise}, beta=0.7),
)
claim("describe", lambda s, v: se.describe(gbuffer(s, v)), pick("gbuffer", "normal", "position"))
claim(
    "describe",
    lambda s, v: se.describe(gbuffer(s, v), sigma=0.9, foreshortening=v["f"], creases=70.0),
    also(NORMAL, f=0.8),
    variant="creases",
    slow=True,
)
claim(
    "describe",
    lambda s, v: se.describe(gbuffer(s, v), sigma=v["sigma"], foreshortening=v["f"]),
    also(pick("gbuffer", "normal", "position"), sigma=2.3, f=0.8),
    variant="fast",
    slow=True,
)
claim(
    "describe",
    lambda s, v: se.describe(gbuffer(s, v), sigma=v["sigma"], importance=v["importance"], scheme="explicit"),
    also(join(pick("gbuffer", "normal", "position"), lambda s: {"importance": 9 * s.noise[..., 0]}), sigma=1.3),
    variant="explicit",
    slow=True,
)
claim(
    "describe_object",
    lambda s, v: se.describe_object(gbuffer(s, v), v["tensor"], s.camera),
    join(pick("gbuffer", "normal", "position"), lambda s: {"tensor": s.curvature}),
)
claim("describe_apparent", lambda s, v: se.describe_apparent(gbuffer(s, v)), NORMAL, slow=True)
claim(
    "describe_relief",
    lambda s, v: se.describe_relief(gbuffer(s, v), sigma=v["sigma"], beta=v["beta"], base=descriptor(s, v)).hessian,
    also(join(NORMAL, HESSIAN), sigma=1.4, beta=0.3),
    slow=True,
)

# ------------------------------------------------------------------------------------------- light: kernels

claim(
    "warp_tensor",
    lambda s, v: se.warp_tensor(v["hessian"], v["alpha"], concave=v["concave"]),
    also(HESSIAN, alpha=9.0, concave=0.6),
)
for _name in ("warp", "unwarp", "warp_jacobian"):
    claim(
        _name,
        lambda s, v, name=_name: getattr(se, name)(v["direction"], v["tensor"]),
        lambda s: {"direction": s.direction, "tensor": s.tensor},
    )
claim(
    "curvature_mapping",
    lambda s, v: se.curvature_mapping(v["hessian"], v["direction"], v["anisotropy"]),
    also(lambda s: {"hessian": s.descriptor.hessian, "direction": s.direction}, anisotropy=0.4),
)
claim(
    "radiance_scale",
    lambda s, v: se.radiance_scale(**v),
    also(
        lambda s: {"kappa": jnp.tanh(s.descriptor.hessian[..., 0] * 20), "delta": s.noise[..., 0]},
        invariant=0.4,
        gamma=1.7,
    ),
)
claim(
    "ashikhmin_shirley",
    lambda s, v: se.ashikhmin_shirley(unit(v["normal"]), unit(v["light"]), unit(v["view"]), material(v)),
    join(
        lambda s: {
            "normal": towards(s.direction, 2.0),
            "light": jnp.roll(s.direction, 1, 0),
            "view": towards(jnp.roll(s.direction, 1, 1), 1.5),
        },
        MATERIAL,
    ),
)
claim(
    "environment_radiance",
    lambda s, v: se.environment_radiance(v["map"], v["direction"]),
    lambda s: {"map": s.map, "direction": s.direction},
)
claim("spherical_harmonics", lambda s, v: se.spherical_harmonics(v["map"]), lambda s: {"map": s.map})
claim(
    "harmonic_radiance",
    lambda s, v: se.harmonic_radiance(v["coefficients"], v["normal"]),
    lambda s: {"coefficients": jnp.concatenate([s.map[0, :1] + 2, 0.2 * s.map[1, :8]]), "normal": s.direction},
)
claim("prefilter_map", lambda s, v: se.prefilter_map(v["map"], height=4), lambda s: {"map": s.map})

# ------------------------------------------------------------------------------------------- light: shading

SHADED = join(pick("gbuffer", "normal", "albedo"), LIGHTS, MATERIAL)
claim("shade", lambda s, v: se.shade(gbuffer(s, v), lights(s, v), material(v)), SHADED)
claim(
    "shade_warped",
    lambda s, v: se.shade_warped(
        gbuffer(s, v),
        descriptor(s, v),
        lights(s, v),
        material(v),
        alpha=v["alpha"],
        gamma=v["gamma"],
        concave=v["concave"],
    ),
    also(join(SHADED, HESSIAN), alpha=9.0, gamma=0.3, concave=0.7),
)
for _name, _more in (("", {}), ("and warped", {"alpha": 7.0, "contrast": 0.2})):
    claim(
        "shade_scaled",
        lambda s, v, more=tuple(_more): se.shade_scaled(
            gbuffer(s, v),
            descriptor(s, v),
            lights(s, v),
            material(v),
            **{k: v[k] for k in ("invariant", "gamma_diffuse", "gamma_specular", "anisotropy", "concave", *more)},
        ),
        also(
            join(SHADED, HESSIAN),
            **{"invariant": 0.3, "gamma_diffuse": 2.0, "gamma_specular": 1.5, "anisotropy": 0.4, "concave": 0.7}
            | _more,
        ),
        variant=_name,
        slow=True,
    )
LOOK = {"contrast": 0.2, "invariant": 0.4, "gamma": 1.3, "anisotropy": 0.3, "concave": 0.7, "alpha": 5.0}
TURN = [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]
for _name, _tint, _more in (
    ("shade_mirror", "reflectance", {}),
    ("shade_refraction", "transmittance", {"ior": 1.4}),
    ("shade_diffuse", "albedo", {}),
):
    claim(
        _name,
        lambda s, v, name=_name, tint=_tint, more=tuple(_more): getattr(se, name)(
            plain(s, v) if tint != "albedo" else replace(s.gbuffer, normal=v["normal"]),
            v["map"],
            descriptor=descriptor(s, v),
            **{k: v[k] for k in ("rotation", tint, *LOOK, *more)},
        ),
        also(
            join(NORMAL, HESSIAN, lambda s: {"map": s.map}), rotation=TURN, **{_tint: [0.9, 0.8, 0.7]}, **LOOK, **_more
        ),
        slow=_name != "shade_diffuse",
    )
claim(
    "shade_forward",
    lambda s, v: se.shade_forward(
        gbuffer(s, v),
        descriptor(s, v),
        v["map"],
        material(v),
        alpha=v["alpha"],
        gamma=v["gamma"],
        rotation=v["rotation"],
        samples=8,
    ),
    also(join(NORMAL, HESSIAN, MATERIAL, lambda s: {"map": s.map}), alpha=5.0, gamma=0.2, rotation=TURN),
    slow=True,
)
PHONG = {
    "ambient": 0.1,
    "diffuse": 0.7,
    "specular": 0.2,
    "shininess": 9.0,
    "exponent": 0.6,
    "alpha": 5.0,
    "contrast": 0.2,
}
PHONG |= {
    "invariant": 0.4,
    "gamma_ambient": 0.5,
    "gamma_diffuse": 1.3,
    "gamma_specular": 0.9,
    "anisotropy": 0.3,
    "concave": 0.7,
}
claim(
    "shade_phong",
    lambda s, v: se.shade_phong(gbuffer(s, v), lights(s, v), descriptor=descriptor(s, v), **{k: v[k] for k in PHONG}),
    also(join(pick("gbuffer", "normal", "albedo", "occlusion"), HESSIAN, LIGHTS), **PHONG),
)
claim(
    "ambient_occlusion",
    lambda s, v: se.ambient_occlusion(
        gbuffer(s, v), s.camera, radius=0.8, descriptor=descriptor(s, v), alpha=v["alpha"], directions=8, steps=3
    ),
    also(join(NORMAL, HESSIAN), alpha=5.0),
)

# ------------------------------------------------------------------------------------------- lines, style, fit

for _kind, _names in (
    ("surface", ("gradient",)),
    ("ridge", ("hessian",)),
    ("inflection", ("hessian",)),
    ("luminance", ()),
):
    claim(
        "line_field",
        lambda s, v, kind=_kind: replace(
            se.line_field(kind, s.gbuffer, descriptor(s, v), luminance=v.get("luminance"), sigma=v["sigma"]),
            singularity=None,
        ),
        also(
            join(
                pick("descriptor", *_names), (lambda s: {"luminance": s.image[..., 0]}) if not _names else lambda s: {}
            ),
            sigma=1.2,
        ),
        variant=_kind,
    )
claim(
    "make_line_field",
    lambda s, v: se.make_line_field(v["height"], v["direction"], mask=s.gbuffer.mask, sigma=v["sigma"]),
    also(pick("field", "height", "direction"), sigma=1.1),
)
claim(
    "fit_profile",
    lambda s, v: replace(se.fit_profile(fields(s.field, v, *v), samples=5), valid=None),
    pick("field", "height", "direction", "singularity"),
)
BRUSH = {"flow": 2.0, "radius": 1.7, "aspect": 0.6, "width": 0.9, "spread": 0.3, "low": 0.1, "high": 1.1, "grow": 0.4}
BRUSH |= {
    "shortest": 3.0,
    "shade": 0.3,
    "paper": 0.4,
    "gaps": 0.9,
    "tint": 0.5,
    "wobble": 0.4,
    "uneven": 0.3,
    "twist": 0.4,
    "color": (0.2, 0.3, 0.1),
}


def drawn(s, v, footprint):
    return se.draw_lines(
        fields(s.profile, v, "distance", "height", "curvature"),
        s.field,
        se.Brush(**{name: v.get(name, number) for name, number in BRUSH.items()}),
        footprint=footprint,
        shading=v.get("shading", s.image),
        noise=v.get("noise", s.noise),
        reach=3,
    )


claim(
    "draw_lines",
    lambda s, v: drawn(s, v, "ellipse"),
    also(
        join(pick("profile", "distance", "height", "curvature"), lambda s: {"shading": s.image, "noise": s.noise}),
        **BRUSH,
    ),
)
claim(
    "draw_lines",
    lambda s, v: drawn(s, v, v["footprint"]),
    lambda s: {"footprint": s.noise[:5, :6], "distance": s.profile.distance},
    variant="image",
    slow=True,
)
claim(
    "composite_lines",
    lambda s, v: se.composite_lines(v["image"], v["strokes"]),
    lambda s: {"image": s.image, "strokes": s.noise},
)
claim(
    "surface_noise",
    lambda s, v: se.surface_noise(gbuffer(s, v), camera(s, v), size=v["size"]),
    also(join(pick("gbuffer", "position"), pick("camera", "view", "projection")), size=6.3),
    slow=True,
)
claim(
    "lit_sphere",
    lambda s, v: se.lit_sphere(
        gbuffer(s, v), v["texture"], concave=v["concave"], descriptor=descriptor(s, v), transition=v["t"]
    ),
    also(join(NORMAL, HESSIAN, lambda s: {"texture": s.texture, "concave": s.map}), t=15.0),
)
claim("auto_exposure", lambda s, v: se.auto_exposure(v["image"], s.gbuffer.mask), IMAGE)
claim(
    "tone_map",
    lambda s, v: se.tone_map(v["image"], exposure=v["exposure"], white=v["white"]),
    also(IMAGE, exposure=0.8, white=3.0),
)
claim(
    "composite",
    lambda s, v: se.composite(v["image"], v["coverage"], v["background"]),
    also(lambda s: {"image": s.image, "coverage": s.noise[..., 0]}, background=[0.2, 0.3, 0.4]),
)
for _measure in ("rms", "michelson", "band"):
    claim(
        "contrast",
        lambda s, v, measure=_measure: se.contrast(v["image"], s.gbuffer.mask, measure=measure, scale=1.0),
        IMAGE,
        variant=_measure,
    )

# ------------------------------------------------------------------------------------------- the whole chain

CHAIN = also(join(GEOMETRY, pick("mesh", "colors"), LIGHTS, MATERIAL), alpha=30.0, gamma=0.2)
for _samples in (1, 2):
    claim(
        "render",
        lambda s, v, samples=_samples: se.render(
            mesh(s, v),
            camera(s, v),
            lights(s, v),
            material(v),
            se.LightWarp(v["alpha"], v["gamma"]),
            height=H,
            width=W,
            samples=samples,
        ),
        CHAIN,
        variant="samples" if _samples > 1 else "",
        slow=True,
    )
SCALED = {"invariant": 0.3, "gamma_diffuse": 2.0, "gamma_specular": 1.5, "anisotropy": 0.4}
claim(
    "render",
    lambda s, v: se.render(
        s.mesh,
        s.camera,
        s.lights,
        material(v),
        se.RadianceScaling(**{k: v[k] for k in SCALED}),
        height=H,
        width=W,
        sigma=v["sigma"],
    ),
    also(MATERIAL, sigma=40.0, **SCALED),
    variant="scaled",
    slow=True,
)
claim(
    "enhance",
    lambda s, v: se.enhance(
        gbuffer(s, v), lights(s, v), material(v), se.RadianceScaling(**{k: v[k] for k in SCALED}), sigma=v["sigma"]
    ),
    also(join(SHADED, pick("gbuffer", "position")), sigma=40.0, **SCALED),
    slow=True,
)
