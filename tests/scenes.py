"""Three small scenes of equal structure and shape, so that one compiled function serves all of them.

`relief`: a smooth height field with an outline, seen orthographically. `torus`: seen obliquely, in perspective, with
inner silhouettes. `rough`: the same torus with crumpled vertices, and random normals, positions and Hessians.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass

import shapeenh as se
from shapeenh.types import replace

SIZE = 20, 24
SCENES = ("relief", "torus", "rough")
VERTICES, FACES = 200, 400
ASPECT = SIZE[1] / SIZE[0]


@register_dataclass
@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a public function may want, [H, W, ...] where it is an image."""

    mesh: se.Mesh  # with colors and uv
    camera: se.Camera
    seen: se.Visibility
    coverage: se.Coverage
    gbuffer: se.GBuffer  # with albedo, occlusion and uv
    descriptor: se.Descriptor
    field: se.LineField
    profile: se.Profile
    lights: se.Lights  # camera frame, 12 of them
    map: jax.Array  # [8, 16, 3] radiance
    texture: jax.Array  # [6, 5, 3]
    direction: jax.Array  # [H, W, 3], unit, all over the sphere
    tensor: jax.Array  # [H, W, 3], a warp tensor
    curvature: jax.Array  # [H, W, 6], an object-centred tensor
    image: jax.Array  # [H, W, 3], a radiance
    noise: jax.Array  # [H, W, 4] in [0, 1]
    points: jax.Array  # [N, 3]
    normals: jax.Array  # [N, 3]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def smooth(rng, *shape, octaves=4):
    """A random trigonometric polynomial, [H, W, *shape], of size about 1."""
    y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SIZE), indexing="ij")
    waves = rng.normal(scale=octaves, size=(6, *shape, 2))
    phase = rng.uniform(0, 2 * np.pi, (6, *shape))
    grid = np.stack([x, y], axis=-1).reshape(*SIZE, *(1,) * len(shape), 2)
    return sum(np.sin(np.sum(grid * waves[k], axis=-1) + phase[k]) for k in range(6)) / np.sqrt(3)


def relief_mesh(rng):
    """A bumpy sheet with a round outline: (vertices, faces, normals)."""
    n = 14
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="xy")
    x, y = u * np.sqrt(1 - 0.5 * v * v), v * np.sqrt(1 - 0.5 * u * u)  # a disc
    a, b = 2.1, 1.7
    z = 0.35 * np.sin(a * x + 0.3) * np.cos(b * y) - 0.2 * (x * x + y * y)
    zx = 0.35 * a * np.cos(a * x + 0.3) * np.cos(b * y) - 0.4 * x
    zy = -0.35 * b * np.sin(a * x + 0.3) * np.sin(b * y) - 0.4 * y
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    p = (i * n + j).reshape(-1)
    faces = np.concatenate([np.stack([p, p + 1, p + n + 1], 1), np.stack([p, p + n + 1, p + n], 1)])
    vertices = np.stack([x, y, z], -1).reshape(-1, 3) + 1e-3 * rng.normal(size=(n * n, 3))
    return vertices, faces, unit(np.stack([-zx, -zy, np.ones_like(z)], -1).reshape(-1, 3))


def make_scene(kind: str) -> Scene:
    """Under x64."""
    rng = np.random.default_rng(SCENES.index(kind) + 11)
    if kind == "relief":
        vertices, faces, normals = relief_mesh(rng)
        camera = se.orthographic_camera((0.2, 0.1, 3.0), (0.0, 0.0, 0.0), height=2.3, aspect=ASPECT)
    else:
        mesh = se.torus(segments=10)
        vertices, faces, normals = (np.asarray(a, np.float64) for a in (mesh.vertices, mesh.faces, mesh.normals))
        # no vertex on a symmetry plane: there would be ties
        vertices = vertices + (1e-3 if kind == "torus" else 0.05) * rng.normal(size=vertices.shape)
        camera = se.perspective_camera((0.3, 1.9, 2.7), (0.0, -0.1, 0.0), fov_degrees=44.0, aspect=ASPECT)
    if kind == "rough":
        normals = normals + 0.4 * rng.normal(size=normals.shape)
    count = len(vertices)
    mesh = se.make_mesh(
        vertices,
        faces.astype(np.int32),
        normals=unit(normals),
        colors=rng.uniform(0.2, 0.9, (count, 3)),
        uv=rng.uniform(0, 1, (count, 2)) if kind == "rough" else vertices[:, :2] * 0.4 + 0.5,
    )
    mesh = replace(se.pad_mesh(mesh, vertices=VERTICES, faces=FACES))
    camera = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), camera)
    h, w = SIZE
    seen = se.rasterize(mesh, camera, height=h, width=w)
    gbuffer = se.render_gbuffer(mesh, camera, height=h, width=w, uv=True)
    mask = np.asarray(gbuffer.mask)
    on = mask[..., None]
    normal, position = np.asarray(gbuffer.normal), np.asarray(gbuffer.position)
    if kind == "rough":
        normal = unit(np.concatenate([rng.normal(size=(h, w, 2)), rng.uniform(0.2, 1.5, (h, w, 1))], -1)) * on
        position = position + 0.02 * rng.normal(size=position.shape) * on
    gbuffer = replace(
        gbuffer,
        normal=normal,
        position=position,
        depth=-position[..., 2],
        occlusion=np.where(mask, rng.uniform(0.1, 0.9, (h, w)), 1),
    )

    hessian = (
        0.05 * smooth(rng, 3) if kind != "rough" else 10 ** rng.uniform(-3, 0.5, (h, w, 1)) * rng.normal(size=(h, w, 3))
    ) * on
    silhouette = np.where(mask, rng.uniform(0.05, 0.6, (h, w)), 0)
    crease = np.where(mask, rng.uniform(0.05, 0.6, (h, w)), 0)
    descriptor = se.Descriptor(
        hessian, smooth(rng, 2) * on, silhouette, crease, (1 - np.maximum(silhouette, crease)) * mask
    )
    direction = unit(smooth(rng, 2) + (0.0 if kind != "rough" else 0.3 * rng.normal(size=(h, w, 2))))
    height = 1.5 + smooth(rng, octaves=9)
    field = se.LineField(height * mask, direction * on, np.where(mask, rng.uniform(0.01, 0.3, (h, w)), 1))
    profile = se.Profile(
        rng.uniform(-1.5, 1.5, (h, w)),
        rng.uniform(0.2, 0.9, (h, w)),
        -rng.uniform(0.05, 0.5, (h, w)),
        rng.random((h, w)) < 0.2,
    )
    shares = np.where(rng.random((h, w, 4)) < 0.2, -1, rng.integers(0, 9, (h, w, 4))).astype(np.int8)
    light = unit(rng.normal(size=(12, 3)) + np.array([0, 0, 0.4]))
    spread = rng.normal(size=(h, w, 3)) * 0.2
    half = 60
    return jax.tree.map(
        jnp.asarray,
        Scene(
            mesh=mesh,
            camera=camera,
            seen=seen,
            coverage=se.Coverage(shares, np.mean(shares >= 0, axis=-1)),
            gbuffer=gbuffer,
            descriptor=descriptor,
            field=field,
            profile=profile,
            lights=se.Lights(light, rng.uniform(0.1, 1.5, (12, 3))),
            map=np.exp(rng.normal(size=(8, 16, 3))),
            texture=rng.uniform(0.1, 0.9, (6, 5, 3)),
            direction=unit(rng.normal(size=(h, w, 3))),
            tensor=np.stack([1.1 + spread[..., 0], spread[..., 1], 0.9 + spread[..., 2]], -1),
            curvature=rng.normal(size=(h, w, 6)),
            image=np.exp(smooth(rng, 3) + (0.0 if kind != "rough" else 0.5 * rng.normal(size=(h, w, 3)))),
            noise=rng.uniform(0.1, 0.9, (h, w, 4)),
            points=mesh.vertices[:half],
            normals=mesh.normals[:half],
        ),
    )
