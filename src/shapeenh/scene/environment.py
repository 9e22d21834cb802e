"""Environment light: latitude-longitude radiance maps and their reduction to N directional lights (SPEC 7).

World y is up. Column centre u and row centre v in [0, 1] look along
`(sin(pi v) sin phi, cos(pi v), -sin(pi v) cos phi)`, phi = 2 pi (u - 1/2): a camera that looks down -z sees the map's
middle.

Every strategy is a partition of the map's pixels into N cells. A light carries the integral of its cell and shines from
the energy's centroid, so the lights sum to the map's integral whatever the strategy, and for a given partition they are
smooth functions of the radiance.
"""

from __future__ import annotations

import functools
import heapq
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh import checks, numerics
from shapeenh.types import Camera, Lights

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

# ------------------------------------------------------------------------------------------- the map on the sphere


@functools.lru_cache(maxsize=4)
def _sphere(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [h, w, 3] of the pixel centres and the solid angle [h, 1] of a pixel, exact, float64."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    direction = np.stack([sin * np.sin(phi), np.broadcast_to(cos, (height, width)), -sin * np.cos(phi)], -1)
    # cos(a) - cos(b) of a row's two borders, written as a product: no cancellation at the poles.
    solid = 4 * np.pi / width * np.sin(theta)[:, None] * np.sin(0.5 * np.pi / height)
    return direction, solid


def map_directions(*, height: int, width: int):
    """World directions of a latitude-longitude map's pixel centres.

    Source: SPEC 7. *Static*: height, width. Returns [h, w, 3], unit.
    """
    height, width = checks.check_size("height", height), checks.check_size("width", width)
    return jnp.asarray(_sphere(height, width)[0], checks.float_dtype())


def map_solid_angles(*, height: int, width: int):
    """Solid angle of each row's pixels, [h, 1], sr; `sum(map * this)` is a map's integral. *Static*: height, width."""
    height, width = checks.check_size("height", height), checks.check_size("width", width)
    return jnp.asarray(_sphere(height, width)[1], checks.float_dtype())


# ------------------------------------------------------------------------------------------- partitions into N cells
# Each takes the energy [h, w] (luminance times solid angle, float64, >= 0) and returns cell numbers [h, w] in [0, N).


def _uniform(energy: np.ndarray, count: int) -> np.ndarray:
    """Cells of about equal solid angle: zones of latitude, cut into equal columns."""
    height, width = energy.shape
    zones = max(1, round(np.sqrt(count * np.pi / 4)))
    # Columns per zone in proportion to its mean circumference, by largest remainders, at least one each.
    weight = np.sin(np.pi * (np.arange(zones) + 0.5) / zones)
    exact = 1 + weight / weight.sum() * (count - zones)
    columns = np.floor(exact).astype(int)
    columns[np.argsort(columns - exact, kind="stable")[: count - columns.sum()]] += 1
    # Zone borders at equal solid angle per cell.
    border = np.concatenate([[0], np.cumsum(columns)]) / count
    height_of_row = 0.5 * (1 - np.cos(np.pi * (np.arange(height) + 0.5) / height))
    zone = np.clip(np.searchsorted(border, height_of_row, side="right") - 1, 0, zones - 1)
    column = (np.arange(width)[None, :] * columns[zone][:, None]) // width
    return np.concatenate([[0], np.cumsum(columns)[:-1]])[zone][:, None] + column


def _importance(energy: np.ndarray, count: int) -> np.ndarray:
    """Strata of about equal energy: zones of latitude by the marginal, cut into columns by the conditional."""
    zones = max(1, round(np.sqrt(count / 2)))
    columns = np.full(zones, count // zones)
    columns[: count - columns.sum()] += 1
    rows = energy.sum(axis=1)
    centre = (np.cumsum(rows) - 0.5 * rows) / rows.sum()
    border = np.concatenate([[0], np.cumsum(columns)]) / count
    zone = np.clip(np.searchsorted(border, centre, side="right") - 1, 0, zones - 1)
    first = np.concatenate([[0], np.cumsum(columns)[:-1]])
    cells = np.zeros(energy.shape, int)
    for z in range(zones):
        in_zone = zone == z
        if in_zone.any():
            across = energy[in_zone].sum(axis=0)
            total = across.sum()
            centre = (np.cumsum(across) - 0.5 * across) / total if total > 0 else np.linspace(0, 1, len(across))
            cells[in_zone] = first[z] + np.minimum((centre * columns[z]).astype(int), columns[z] - 1)
    return cells


def _median_cut(energy: np.ndarray, count: int) -> np.ndarray:
    """Debevec 2005: cut a cell in two of equal energy across its longer side, the cell with most to gain first.

    The gain is energy times squared angular size, which is what the error of a centroid light grows with; a plain
    breadth-first median cut needs N to be a power of two and wastes lights on cells of a single bright pixel.
    """
    height, width = energy.shape
    table = np.zeros((height + 1, width + 1))
    table[1:, 1:] = np.cumsum(np.cumsum(energy, axis=0), axis=1)
    row_sine = np.sin(np.pi * (np.arange(height + 1)) / height)

    def box(top, bottom, left, right):
        return table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]

    def sides(top, bottom, left, right):
        across = row_sine[(top + bottom) // 2]
        return np.pi * (bottom - top) / height, 2 * np.pi * (right - left) / width * across

    def entry(cell):
        tall, wide = sides(*cell)
        single = (cell[1] - cell[0]) * (cell[3] - cell[2]) == 1
        return (0.0 if single else -max(box(*cell), 0.0) * (tall * tall + wide * wide)), cell

    queue = [entry((0, height, 0, width))]
    done: list[tuple[int, int, int, int]] = []
    while queue and len(queue) + len(done) < count:
        gain, cell = heapq.heappop(queue)
        top, bottom, left, right = cell
        if gain == 0 and (bottom - top) * (right - left) == 1:
            done.append(cell)
            continue
        tall, wide = sides(*cell)
        if (tall >= wide and bottom - top > 1) or right - left == 1:
            sums = table[top : bottom + 1, right] - table[top : bottom + 1, left]
            cut = top + _middle(sums - sums[0])
            parts = (top, cut, left, right), (cut, bottom, left, right)
        else:
            sums = table[bottom, left : right + 1] - table[top, left : right + 1]
            cut = left + _middle(sums - sums[0])
            parts = (top, bottom, left, cut), (top, bottom, cut, right)
        for part in parts:
            heapq.heappush(queue, entry(part))
    cells = np.zeros(energy.shape, int)
    for i, (top, bottom, left, right) in enumerate(sorted([cell for _, cell in queue] + done)):
        cells[top:bottom, left:right] = i
    return cells


def _middle(cumulative: np.ndarray) -> int:
    """Where to cut so that both sides hold as equal energy as possible, each at least one pixel wide."""
    return int(np.clip(np.argmin(np.abs(cumulative - 0.5 * cumulative[-1])), 1, len(cumulative) - 2))


_METHODS = {"uniform": _uniform, "importance": _importance, "median_cut": _median_cut}

# ------------------------------------------------------------------------------------------- map to lights


def _clean(radiance: np.ndarray) -> tuple[np.ndarray, int]:
    """Negative and NaN become 0, +inf the largest finite value; and how many pixels were touched."""
    bad = ~(radiance >= 0) | np.isinf(radiance)
    if not bad.any():
        return radiance, 0
    finite = radiance[np.isfinite(radiance)]
    top = max(float(finite.max()), 0.0) if finite.size else 0.0
    cleaned = np.where(np.isposinf(radiance), top, np.where(radiance >= 0, radiance, 0))
    return cleaned, int(np.count_nonzero(bad.any(axis=-1)))


def _host_lights(radiance: np.ndarray, count: int, method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(direction [N, 3], radiance [N, 3], cells [h, w]) in float64 on the host; `radiance` is clean."""
    direction, solid = _sphere(*radiance.shape[:2])
    weighted = radiance * solid[:, :, None]
    energy = weighted @ _LUMINANCE
    top = energy.max(initial=0.0)
    cells = _METHODS[method](energy / top, count) if top > 0 else _uniform(energy, count)

    def total(values):
        return np.stack(
            [np.bincount(cells.ravel(), v.ravel(), minlength=count) for v in np.moveaxis(values, -1, 0)], -1
        )

    centroid, scale = (
        total((energy / top if top > 0 else energy)[..., None] * direction),
        total(energy[..., None]) / (top or 1),
    )
    # A cell without energy, or whose energy has no middle (all around the sphere), shines from the cell's own middle.
    middle = total(solid[..., None] * direction) + 1e-12 * np.array([0.0, 1.0, 0.0])
    centroid = np.where(np.linalg.norm(centroid, axis=-1, keepdims=True) > 1e-6 * scale, centroid, middle)
    return centroid / np.linalg.norm(centroid, axis=-1, keepdims=True), total(weighted), cells


def _smooth_lights(radiance, cells, count: int):
    """The same as `_host_lights` for given cells, as a differentiable function of the map."""
    direction, solid = (jnp.asarray(a, radiance.dtype) for a in _sphere(*radiance.shape[:2]))
    weighted = radiance * solid[:, :, None]
    centroid = numerics.luminance(weighted)[..., None] * direction
    centroid, energy = (
        jax.ops.segment_sum(a.reshape(-1, 3), cells.reshape(-1), num_segments=count) for a in (centroid, weighted)
    )
    return numerics.normalize(centroid), energy


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def _traced_lights(radiance, count: int, method: str):
    return _traced_forward(radiance, count, method)[0]


def _traced_forward(radiance, count: int, method: str):
    def host(radiance):
        clean, _ = _clean(np.asarray(radiance, np.float64))
        direction, energy, cells = _host_lights(clean, count, method)
        return direction.astype(radiance.dtype), energy.astype(radiance.dtype), cells.astype(np.int32)

    lights = jax.ShapeDtypeStruct((count, 3), radiance.dtype)
    shapes = lights, lights, jax.ShapeDtypeStruct(radiance.shape[:2], jnp.int32)
    direction, energy, cells = jax.pure_callback(host, shapes, radiance, vmap_method="sequential")
    return (direction, energy), (radiance, cells)


def _traced_backward(count: int, method: str, saved, cotangent):
    radiance, cells = saved
    good = (radiance >= 0) & jnp.isfinite(radiance)
    _, pull = jax.vjp(lambda r: _smooth_lights(r, cells, count), jnp.where(good, radiance, 0))
    return (jnp.where(good, pull(cotangent)[0], 0),)


_traced_lights.defvjp(_traced_forward, _traced_backward)


def sample_environment(radiance_map, count, *, rotation=None, method="median_cut"):
    """Reduces a latitude-longitude radiance map to `count` directional lights.

    Source: SPEC 7; LW09 6.1; `median_cut` after Debevec 2005.
    radiance_map: [h, w, 3], linear RGB, >= 0. rotation: None; [3, 3], which turns the map's world into the scene's; or
    an angle [] in radians about world y (counter-clockwise seen from above).
    *Static*: count, 1 to 1048576; method, one of `"uniform"` (cells of equal solid angle), `"importance"` (strata of
    equal energy), `"median_cut"` (cells cut where energy times size is largest; at 54 lights a quarter to
    two fifths less error than the others on average, `benchmarks/sampling.py`). All are deterministic.
    Returns `Lights` in world directions; radiance sums to the map's integral over the sphere (to 1e-5 in float32); a
    light whose cell is dark has radiance 0.
    Negative and NaN values count as 0, infinite ones as the largest finite value; one `UserWarning` says how many
    pixels were replaced (where the map is concrete).
    Gradient: in radiance_map (light colours and directions, with the partition fixed) and rotation; works under jit
    through a host callback.
    Errors: ValueError for another shape, count or method, a map without energy, or a rotation that is not finite.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    count = checks.check_size("count", count, high=1 << 20)
    checks.check_choice("method", method, tuple(_METHODS))
    dtype = checks.float_dtype(radiance_map)
    if checks.is_concrete(radiance_map):
        clean, touched = _clean(np.asarray(radiance_map, np.float64))
        if not clean.any():
            raise ValueError("radiance_map holds no energy; accepted is a map with at least one positive value")
        if touched:
            warnings.warn(
                f"radiance_map: {touched} of {clean.shape[0] * clean.shape[1]} pixels held negative, NaN or infinite "
                "values; negative and NaN became 0, infinite the largest finite value",
                UserWarning,
                stacklevel=2,
            )
        host_direction, host_radiance, _ = _host_lights(clean, count, method)
        direction, radiance = jnp.asarray(host_direction, dtype), jnp.asarray(host_radiance, dtype)
    else:
        direction, radiance = _traced_lights(jnp.asarray(radiance_map, dtype), count, method)
    if rotation is not None:
        direction = _rotate(direction, _rotation_matrix(rotation, dtype))
    return Lights(direction=direction, radiance=radiance)


def _rotation_matrix(rotation, dtype):
    checks.check_finite("rotation", rotation)
    rotation = jnp.asarray(rotation, dtype)
    if rotation.ndim == 0:
        c, s, one, zero = jnp.cos(rotation), jnp.sin(rotation), jnp.ones((), dtype), jnp.zeros((), dtype)
        return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
    checks.check_shape("rotation", rotation, (3, 3))
    return rotation


@jax.jit
def _rotate(direction, matrix):
    """Directions [N, 3] turned by the first 3 x 3 of a matrix."""
    # An explicit sum: a matrix product may run in lower precision on accelerators.
    return jnp.sum(matrix[None, :3, :3] * direction[:, None, :], axis=-1)


def rotate_lights(lights: Lights, camera: Camera) -> Lights:
    """World directions to the camera's frame, the one of the normals.

    Source: DESIGN 2. lights: `Lights`, world. camera: `Camera`; the rotation of its `view` is used.
    Returns `Lights` in camera space. Gradient: exact in both. Errors: ValueError for a wrong record or shape, for
    values that are not finite.
    """
    checks.check_type("lights", lights, Lights)
    checks.check_type("camera", camera, Camera)
    checks.check_shape("camera.view", camera.view, (4, 4))
    checks.check_shape("lights.direction", lights.direction, (None, 3))
    checks.check_finite("camera.view", camera.view)
    checks.check_finite("lights.direction", lights.direction)
    dtype = checks.float_dtype(lights.direction)
    direction = _rotate(jnp.asarray(lights.direction, dtype), jnp.asarray(camera.view, dtype))
    return Lights(direction=direction, radiance=lights.radiance)


# ------------------------------------------------------------------------------------------- embedded defaults


def _glow(direction, towards, inner: float, outer: float):
    """A soft disc: 1 within `inner` radians of a direction, 0 beyond `outer`."""
    towards = np.asarray(towards, float) / np.linalg.norm(towards)
    angle = np.arccos(np.clip(direction @ towards, -1, 1))
    t = np.clip((outer - angle) / (outer - inner), 0, 1)
    return (t * t * (3 - 2 * t))[..., None]


def _panel(direction, towards, half_width: float, half_height: float, soft: float = 0.08):
    """A soft-edged rectangle that faces the centre of the sphere from a direction; sizes as tangents of angles."""
    axis = np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], axis)
    right /= np.linalg.norm(right)
    up = np.cross(axis, right)
    depth = direction @ axis
    safe = np.where(depth > 0.05, depth, np.inf)
    edge = [
        np.clip((half - np.abs(direction @ side) / safe) / soft + 0.5, 0, 1)
        for half, side in ((half_width, right), (half_height, up))
    ]
    return (np.where(depth > 0.05, edge[0] * edge[1], 0))[..., None]


def procedural_sky(*, height=128, sun=(-0.55, 0.55, 0.62)):
    """A clear sky: deep blue above, warm and bright at the horizon, a sun with its halo, a dim ground.

    *Static*: height, rows of the map (columns are twice as many); sun, world direction of the sun.
    Returns a radiance map [h, 2h, 3], linear RGB. The default sun stands high on the left, behind a viewer who looks
    down -z. Errors: ValueError for a height below 4 or a zero direction.
    """
    height = checks.check_size("height", height, low=4, high=8192)
    if not np.linalg.norm(sun) > 0:
        raise ValueError(f"sun is {sun!r}; accepted is a direction other than zero")
    direction, _ = _sphere(height, 2 * height)
    y = direction[..., 1:2]
    # Blue deepens with elevation; aerosols whiten the lowest degrees and warm the side of the sun.
    level = np.clip(y, 0, 1)
    zenith, horizon, warm = np.array([0.10, 0.22, 0.58]), np.array([0.62, 0.74, 0.90]), np.array([1.0, 0.72, 0.45])
    haze = np.exp(-5.5 * level)
    flat = direction * np.array([1.0, 0.0, 1.0])
    towards = np.asarray(sun, float) / np.linalg.norm(sun)
    side = np.clip(0.5 + 0.5 * flat @ (towards * np.array([1.0, 0.0, 1.0]))[:, None], 0, 1) ** 2
    sky = zenith * (1 - haze) + (horizon * (1 - 0.55 * side) + 1.3 * warm * 0.55 * side) * haze
    ground = np.array([0.115, 0.095, 0.075]) * (1 + 0.8 * np.exp(6 * np.minimum(y, 0)))
    t = np.clip(0.5 + y / 0.06, 0, 1)
    t = t * t * (3 - 2 * t)
    sunny = np.array([1.0, 0.90, 0.74])
    halo = sunny * (24.0 * _glow(direction, towards, 0.06, 0.20) + 1.1 * _glow(direction, towards, 0.0, 0.7) ** 2)
    return jnp.asarray(ground * (1 - t) + sky * t + halo * t, checks.float_dtype())


def procedural_studio(*, height=128):
    """A photographer's studio: a key panel, a cool fill, two rim strips, a reflector below, a graded room.

    *Static*: height, rows of the map (columns are twice as many).
    Returns a radiance map [h, 2h, 3], linear RGB. Key high on the left and fill on the right stand behind a viewer who
    looks down -z, the rims behind the object. Errors: ValueError for a height below 4.
    """
    height = checks.check_size("height", height, low=4, high=8192)
    direction, _ = _sphere(height, 2 * height)
    y = direction[..., 1:2]
    room = np.array([0.055, 0.058, 0.066]) * (1 + 1.2 * np.clip(y, 0, 1)) + np.array([0.05, 0.042, 0.035]) * np.clip(
        -y, 0, 1
    )
    warm, cool, neutral = np.array([1.0, 0.93, 0.82]), np.array([0.72, 0.85, 1.0]), np.ones(3)
    lamps = [
        (26.0 * warm, (-0.55, 0.75, 0.55), 0.30, 0.30),
        (0.7 * cool, (0.95, 0.00, 0.40), 0.45, 0.70),
        (9.0 * neutral, (-0.90, 0.10, -0.35), 0.10, 0.90),
        (9.0 * cool, (0.85, 0.35, -0.45), 0.12, 0.90),
        (0.35 * warm, (0.05, -0.80, 0.60), 0.60, 0.25),
    ]
    out = np.broadcast_to(room, direction.shape).copy()
    for colour, towards, half_width, half_height in lamps:
        out += colour * _panel(direction, towards, half_width, half_height)
    return jnp.asarray(out, checks.float_dtype())
