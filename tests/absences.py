"""Where public functions say that they have no gradient, a biased one, or one by convention: a table of `Absence`s.

At `at(scene)` the derivative is exactly 0 (`kind` "zero"), or just finite ("finite": a kink or a convention), or
refused by a ValueError ("refused"), while the function does change when its argument moves by `step(scene)`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from shapeenh.scene.environment import map_directions
from shapeenh.types import replace
from tests.claims import H, W, lights, material
from tests.scenes import Scene, unit


@dataclass(frozen=True)
class Absence:
    name: str
    what: str
    call: Callable[[Scene, jax.Array], object]
    at: Callable[[Scene], object]
    step: Callable[[Scene], object]
    kind: str = "zero"
    slow: bool = False

    @property
    def id(self) -> str:
        return f"{self.name}-{self.what}"


ABSENCES: list[Absence] = []


def absence(name, what, call, at, step, *, kind="zero", slow=False):
    ABSENCES.append(Absence(name, what, call, at, step, kind, slow))


def number(x):
    return lambda s: jnp.asarray(x, jnp.float64)


def moved(s, vertices):
    return replace(s.mesh, vertices=vertices)


VERTICES = lambda s: s.mesh.vertices  # noqa: E731
SMALLER = lambda s: -0.3 * s.mesh.vertices  # noqa: E731
FACING = np.tile([[0.0, 0.0, 1.0]], (3, 1))
UMBILIC = number([[-0.2, 0.0, -0.2], [0.0, 0.0, 0.0], [0.3, 0.0, 0.3]])
BEND = number([[0.1, 0.05, -0.1]] * 3)

# ------------------------------------------------------------------------------------------- visibility and coverage

absence(
    "rasterize",
    "visibility",
    lambda s, x: (se.rasterize(moved(s, x), s.camera, height=H, width=W).triangle >= 0).astype(x.dtype),
    VERTICES,
    SMALLER,
)
absence(
    "render_gbuffer",
    "mask",
    lambda s, x: se.render_gbuffer(moved(s, x), s.camera, height=H, width=W).mask.astype(x.dtype),
    VERTICES,
    SMALLER,
)
absence(
    "render_gbuffer",
    "outline",  # the area that a flat, evenly shaded thing covers moves with its vertices, and its derivative does not
    lambda s, x: (
        se.render_gbuffer(se.Mesh(x, np.array([[0, 1, 2]]), FACING), s.camera, height=H, width=W)
        .mask.astype(x.dtype)
        .sum()
    ),
    number([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
    number([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [0.0, -0.5, 0.0]]),
)
absence(
    "sample_coverage",
    "coverage",
    lambda s, x: se.sample_coverage(moved(s, x), s.camera, s.gbuffer, samples=2).fraction,
    VERTICES,
    SMALLER,
    slow=True,
)
absence(
    "render",
    "outline",  # of a triangle that radiates alike everywhere
    lambda s, x: se.render(
        se.Mesh(x, np.array([[0, 1, 2]]), FACING),
        s.camera,
        se.Lights(jnp.eye(3)[2:], jnp.ones((1, 3))),
        se.Material(jnp.full(3, 0.5)),
        height=H,
        width=W,
    ),
    number([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
    number([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [0.0, -0.5, 0.0]]),
    slow=True,
)
absence(
    "gbuffer_from_points",
    "mask",
    lambda s, x: se.gbuffer_from_points(s.points, s.normals, x, s.camera, height=H, width=W).mask.astype(x.dtype),
    number(0.2),
    number(0.3),
)
absence(
    "ambient_occlusion",
    "visibility",
    lambda s, x: se.ambient_occlusion(replace(s.gbuffer, depth=x), s.camera, radius=0.8, directions=8, steps=3),
    lambda s: s.gbuffer.depth,
    lambda s: 0.2 * s.noise[..., 0] * s.gbuffer.mask,
)
absence("estimate_normals", "tracers", lambda s, x: se.estimate_normals(x), lambda s: s.points, SMALLER, kind="refused")
absence("estimate_radius", "tracers", lambda s, x: se.estimate_radius(x), lambda s: s.points, SMALLER, kind="refused")

# ------------------------------------------------------------------------------------------- what an image leaves out

absence(
    "decode_normals",
    "black pixels",
    lambda s, x: se.decode_normals(x),
    lambda s: jnp.zeros((2, 3, 3)),
    lambda s: jnp.full((2, 3, 3), 0.8),
)
absence(
    "gbuffer_from_normals",
    "held n_z",
    lambda s, x: (
        se.gbuffer_from_normals(jnp.stack([jnp.full_like(x, 0.9), jnp.full_like(x, 0.4), x], -1), check=False).normal
    ),
    lambda s: jnp.zeros((2, 3)),
    lambda s: jnp.full((2, 3), 0.2),
)
absence(
    "gbuffer_from_height",
    "plane of depth",  # all depths follow the highest point, whose derivative goes nowhere
    lambda s, x: se.gbuffer_from_height(jnp.zeros((3, 4)).at[1, 1].set(x)).depth[:, 2:],
    number(1.0),
    number(0.5),
)
absence(
    "gbuffer_from_height",
    "torn surface",
    lambda s, x: se.gbuffer_from_height(s.field.height, max_slope=x).normal,
    number(0.3),
    number(0.4),
)
absence(
    "sample_texture",
    "clamped",
    lambda s, x: se.sample_texture(s.texture, jnp.stack([x, 0.3], -1), wrap="clamp"),
    number(1.3),
    number(-0.7),
)
absence(
    "describe",
    "held n_z",
    lambda s, x: se.describe(replace(s.gbuffer, normal=s.gbuffer.normal.at[..., 2].set(x))).gradient,
    number(0.005),
    number(0.2),
    slow=True,
)
for _name, _call in (
    ("line_field", lambda s, x: se.line_field("surface", s.gbuffer, replace(s.descriptor, silhouette=x)).height),
    (
        "make_line_field",
        lambda s, x: se.make_line_field(s.field.height, s.field.direction, silhouette=x, sigma=1.0).height,
    ),
):
    absence(_name, "silhouettes", _call, lambda s: s.descriptor.silhouette, lambda s: 0.3 * s.noise[..., 0])
absence(
    "fit_profile",
    "valid",
    lambda s, x: se.fit_profile(replace(s.field, height=x), samples=5).valid.astype(x.dtype),
    lambda s: s.field.height,
    lambda s: s.noise[..., 0],
)
absence(
    "draw_lines",
    "below the threshold",
    lambda s, x: se.draw_lines(replace(s.profile, height=x), s.field, se.Brush(low=1.0, high=2.0), reach=2),
    lambda s: s.profile.height,
    lambda s: 2 * s.profile.height,
)
absence(
    "curvature_colors",
    "saturated",
    lambda s, x: se.curvature_colors(
        replace(s.descriptor, hessian=x, silhouette=0 * x[..., 0]), s.gbuffer.mask, scale=0.1
    ),
    lambda s: jnp.full((H, W, 3), -0.3),
    lambda s: jnp.full((H, W, 3), 0.35),
)

absence(
    "sample_environment",
    "negative pixels",
    lambda s, x: se.sample_environment(s.map.at[2, 3].set(x), 5),
    number([-1.0, -2.0, -3.0]),
    number([3.0, 4.0, 9.0]),
)
absence(
    "describe",
    "silhouettes off their flanks",
    lambda s, x: se.describe(_step(x)).silhouette,
    number(0.0),
    number(9.0),
    slow=True,
)
for _name, _call in (
    ("describe_object", lambda s, g: se.describe_object(g, s.curvature, s.camera).gradient),
    ("describe_apparent", lambda s, g: se.describe_apparent(g).gradient),
):
    absence(
        _name,
        "held n_z",
        lambda s, x, call=_call: call(
            s, replace(s.gbuffer, normal=s.gbuffer.normal.at[..., 2].set(x * s.noise[..., 0]))
        ),
        number(0.005),
        number(0.2),
        slow=True,
    )
for _name, _call in (
    ("line_field", lambda s, x: se.line_field("surface", s.gbuffer, replace(s.descriptor, gradient=x))),
    ("make_line_field", lambda s, x: se.make_line_field(jnp.ones_like(x[..., 0]), x)),
):
    absence(
        _name,
        "no direction",
        _call,
        lambda s: jnp.zeros((H, W, 2)),
        lambda s: s.field.direction + 0.1,
        kind="finite",
    )
absence(
    "fit_profile",
    "not valid",  # far from every line the profile is 0, whatever the height does a little
    lambda s, x: se.fit_profile(replace(s.field, height=x * jnp.ones((H, W))), samples=5).distance,
    lambda s: jnp.ones((H, W)),
    lambda s: s.field.height,
)


def _step(x):
    """A plane whose right half lies farther back by x."""
    right = jnp.arange(W) >= W // 2
    depth = jnp.broadcast_to(3 + x * right, (H, W))
    return se.GBuffer(
        jnp.ones((H, W), bool),
        depth,
        jnp.broadcast_to(jnp.eye(3)[2], (H, W, 3)),
        jnp.stack([*jnp.meshgrid(0.05 * jnp.arange(W), -0.05 * jnp.arange(H)), -depth], -1),
    )


# ------------------------------------------------------------------------------------------- between two texels
# Look-ups that hit the middle of a texel, where four bilinear patches meet: the derivative is that of one of them.


def _facing(s, normal):
    return replace(s.gbuffer, normal=jnp.broadcast_to(normal, (H, W, 3)), mask=jnp.ones((H, W), bool))


_MIDDLE = np.asarray(map_directions(height=8, width=16))[3, 1]  # its z is positive
_UV, _ASIDE = number([0.3, 0.25]), number([0.13, 0.2])
absence("sample_texture", "between texels", lambda s, x: se.sample_texture(s.texture, x), _UV, _ASIDE, kind="finite")
for _name, _call in (
    (
        "apply_texture",
        lambda s, uv: se.apply_texture(replace(s.gbuffer, uv=jnp.broadcast_to(uv, (H, W, 2))), s.texture),
    ),
    (
        "apply_normal_map",
        lambda s, uv: se.apply_normal_map(
            s.gbuffer,
            replace(s.mesh, uv=jnp.broadcast_to(uv, s.mesh.uv.shape)),
            s.camera,
            s.seen,
            s.texture,
            space="object",
            check=False,
        ),
    ),
):
    absence(_name, "between texels", _call, _UV, _ASIDE, kind="finite")
absence(
    "environment_radiance",
    "between texels",
    lambda s, x: se.environment_radiance(s.map, x),
    number(_MIDDLE),
    number([0.3, -0.2, 0.0]),
    kind="finite",
)
for _name, _at, _call in (
    ("shade_mirror", _MIDDLE + [0.0, 0.0, 1.0], lambda s, g: se.shade_mirror(g, s.map)),
    ("shade_diffuse", _MIDDLE, lambda s, g: se.shade_diffuse(g, s.map)),
    ("shade_refraction", [0.0, 0.0, 1.0], lambda s, g: se.shade_refraction(g, s.map[:, :15], ior=1.4)),
):
    absence(
        _name,
        "between texels",
        lambda s, x, call=_call: call(s, _facing(s, x)),
        number(unit(np.asarray(_at))),
        number([0.2, -0.2, 0.0]),
        kind="finite",
    )
absence(
    "lit_sphere",
    "beyond the rim",
    lambda s, x: se.lit_sphere(_facing(s, x), s.texture),
    number([1.7, -1.6, 0.0]),
    number([-1.3, 1.1, 0.0]),
)

# ------------------------------------------------------------------------------------------- degenerate geometry

FLAT = number([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [2.0, 1.0, 0.0]])
LIFT = number([[0.0, 0.0, 1.0], [0.0, 0.0, 0.3], [1.0, 0.0, 0.0]])
absence("vertex_normals", "no area", lambda s, x: se.vertex_normals(x, np.array([[0, 1, 2]])), FLAT, LIFT)
absence("make_mesh", "no area", lambda s, x: se.make_mesh(x, np.array([[0, 1, 2]])).normals, FLAT, LIFT)
absence(
    "vertex_curvature",
    "no area",
    lambda s, x: se.vertex_curvature(se.Mesh(x, np.array([[0, 1, 2]]), s.mesh.normals[:3])),
    FLAT,
    LIFT,
)
absence(
    "frame_mesh",
    "what touches the frame",  # a vertex inside of it counts for nothing, until it is outside
    lambda s, x: se.frame_mesh(moved(s, jnp.zeros_like(s.mesh.vertices).at[:4].set(_FRAME).at[0].set(x))).view,
    number([0.1, 0.05, 0.0]),
    number([4.0, 2.0, 0.0]),
)
_FRAME = np.array([[0.1, 0.05, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [0.0, 0.3, 0.2]])

# ------------------------------------------------------------------------------------------- umbilics, poles, clamps

absence("principal_curvatures", "umbilics", lambda s, x: jnp.subtract(*se.principal_curvatures(x)), UMBILIC, BEND)
absence("principal_directions", "umbilics", lambda s, x: se.principal_directions(x), UMBILIC, BEND)
absence("warp_tensor", "kink", lambda s, x: se.warp_tensor(x, 9.0, concave=0.3), UMBILIC, BEND, kind="finite")
for _name in ("warp", "unwarp", "warp_jacobian"):
    absence(
        _name,
        "pole",
        lambda s, x, name=_name: getattr(se, name)(x, s.tensor[0]),
        lambda s: jnp.zeros((W, 3)).at[:, 2].set(-1),
        lambda s: jnp.zeros((W, 3)).at[:, 0].set(0.6).at[:, 2].set(0.2),
        kind="finite",
    )
absence(
    "environment_radiance",
    "poles",
    lambda s, x: se.environment_radiance(s.map, x),
    number([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]),
    number([[0.6, -0.2, 0.0], [0.0, 0.2, 0.6]]),
)
absence(
    "harmonic_radiance",
    "below 0",
    lambda s, x: se.harmonic_radiance(jnp.zeros((9, 3)).at[0].set(x), s.direction),
    number([-1.0, -2.0, -3.0]),
    number([2.0, 3.0, 4.0]),
)
absence(
    "radiance_scale",
    "delta above 1",
    lambda s, x: se.radiance_scale(-0.5, x, 0.3, 2.0),
    number([1.2, 7.0]),
    number([-0.8, -6.5]),
)
absence(
    "radiance_scale", "delta below 0", lambda s, x: se.radiance_scale(-0.5, x, 0.3, 2.0), number([-0.2]), number([0.8])
)
absence(
    "ashikhmin_shirley",
    "behind",
    lambda s, x: se.ashikhmin_shirley(jnp.eye(3)[2], x, jnp.eye(3)[2], material({})),
    number([[0.6, 0.0, -0.8], [0.0, 0.0, -1.0]]),
    number([[0.0, 0.0, 1.6], [0.6, 0.0, 1.8]]),
)
absence(
    "shade",
    "behind",
    lambda s, x: se.shade(s.gbuffer, se.Lights(x, jnp.ones_like(x)), material({})),
    number([[0.0, 0.0, -1.0]]),
    number([[0.0, 0.0, 2.0]]),
)
# A light whose partner, from where the warp takes its radiance, sets: off, whatever the strength does a little.
for _name, _options in (
    ("shade_warped", {}),
    ("shade_scaled", {"invariant": 0.5, "gamma_diffuse": 1.0, "gamma_specular": 1.0}),
):
    absence(
        _name,
        "partner sets",
        lambda s, x, name=_name, options=_options: getattr(se, name)(
            _facing(s, jnp.asarray([0.0, 0.0, 1.0])),
            replace(s.descriptor, hessian=jnp.broadcast_to(jnp.asarray([-0.2, 0.0, -0.2]), (H, W, 3))),
            se.Lights(jnp.asarray([[0.995, 0.0, 0.1]]), jnp.ones((1, 3))),
            material({}),
            alpha=x,
            **options,
        ),
        number(40.0),
        number(-39.9),
        slow=True,
    )
absence(
    "shade_forward",
    "limb",
    lambda s, x: se.shade_forward(
        replace(s.gbuffer, normal=s.gbuffer.normal.at[..., 2].set(x)),
        s.descriptor,
        s.map,
        material({}),
        alpha=9.0,
        samples=8,
    ),
    number(0.0),
    number(0.3),
    kind="finite",
    slow=True,
)
absence(
    "shade_phong",
    "dark lobes",
    lambda s, x: se.shade_phong(s.gbuffer, se.Lights(x, jnp.ones_like(x))),
    number([[0.0, 0.0, -1.0]]),
    number([[0.0, 0.0, 2.0]]),
)
absence(
    "shade",
    "limb",  # |n_z|
    lambda s, x: se.shade(replace(s.gbuffer, normal=s.gbuffer.normal.at[..., 2].set(x)), lights(s, {}), material({})),
    number(0.0),
    number(0.3),
    kind="finite",
)

absence(
    "surface_noise",
    "octaves",  # cells of exactly a power of two: an orthographic view of a plane, 1 world unit high
    lambda s, x: se.surface_noise(
        _step(0.0), se.orthographic_camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), height=1.0, aspect=W / H), size=x
    ),
    number(H / 4),
    number(-1.5),
    kind="finite",
    slow=True,
)

# ------------------------------------------------------------------------------------------- pictures and fits

GREY = lambda s: jnp.full((H, W, 3), 0.4)  # noqa: E731
SPECKLE = lambda s: 0.3 * s.noise[..., :3]  # noqa: E731
for _measure in ("rms", "band", "michelson"):
    absence(
        "contrast",
        f"uniform picture, {_measure}",
        lambda s, x, measure=_measure: se.contrast(x, s.gbuffer.mask, measure=measure, scale=1.0),
        GREY,
        SPECKLE,
        kind="finite" if _measure == "michelson" else "zero",
    )
absence(
    "auto_exposure", "black", lambda s, x: se.auto_exposure(x, s.gbuffer.mask), lambda s: jnp.zeros((H, W, 3)), GREY
)


def _fit(start):
    return se.fit_contrast(
        lambda p: jnp.linspace(0.1, 1, 12).reshape(3, 4) ** p, 0.6, start, mask=np.ones((3, 4), bool), bounds=(0.1, 5.0)
    ).parameters


absence("fit_contrast", "start", lambda s, x: _fit(x), number(1.0), number(0.5), kind="refused")
absence(
    "fit_image",
    "reference",
    lambda s, x: (
        se.fit_image(lambda p: p * jnp.ones((3, 4)), x, 0.3, mask=np.ones((3, 4), bool), bounds=(0.1, 5.0)).parameters
    ),
    lambda s: jnp.ones((3, 4)),
    lambda s: jnp.ones((3, 4)),
    kind="refused",
)

# ------------------------------------------------------------------------------------------- neither of both

NOT_NUMERIC = {
    "records": """Brush Camera Coverage Descriptor FitResult GBuffer LightWarp Lights LineField Material Mesh Profile
        RadianceScaling Visibility""",
    "files": "load_environment load_height load_image load_mesh load_points save_image",
    "made by NumPy on the host": "carved_knot plane sphere torus procedural_sky procedural_studio curvature_legend",
    "display alone": "line_integral_convolution",
    "look-ups by name": "fit_radius named_material style_brush style_footprint",
    "settings": "keep_memory",
}
