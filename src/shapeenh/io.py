"""Everything that touches a disk: meshes, environment maps, images."""

from __future__ import annotations

import contextlib
import io as _io
import logging
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from shapeenh import codecs
from shapeenh.checks import check_range
from shapeenh.scene.mesh import check_faces, make_mesh
from shapeenh.types import Mesh

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
POINT_SUFFIXES = (".ply", ".xyz", ".txt", ".pts")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff")
FAR_FROM_ORIGIN = 1e3  # centre distance over extent from which float32 loses visible detail: the mesh is then recentred


# ------------------------------------------------------------------------------------------- meshes


def load_mesh(path, *, crease_degrees: float | None = None) -> Mesh:
    """Read a triangle mesh: OBJ, PLY, STL, OFF, GLB, GLTF.

    Scenes and multi-body files are merged, polygons triangulated. Vertex normals are the file's own, or angle-weighted
    over vertices at the same position, so that texture seams and triangle soups (STL) look smooth. Coordinates are
    float64 until here; a mesh further from the origin than 1000 times its size is recentred before it becomes float32,
    and a warning tells the offset. Faces that use NaN or infinite vertices are dropped, and a warning counts them.

    Args:
        path: the file.
        crease_degrees: split the normals at edges sharper than this many degrees, ]0, 180[; None keeps all edges
            smooth. Ignored where the file has normals.

    Returns: `Mesh`; `colors` in linear RGB where the file has vertex or face colours, `uv` where it has them.
    Errors: FileNotFoundError; ValueError for an unknown suffix, an unreadable file, or no face that can be drawn.

    >>> mesh = se.load_mesh("bunny.obj")
    """
    path = _existing(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ValueError(f"{path} has the suffix {path.suffix!r}; accepted are meshes {', '.join(MESH_SUFFIXES)}")
    if crease_degrees is not None:
        check_range("crease_degrees", crease_degrees, 0, 180, open_ends=True)
    parts = _read_parts(path)
    if not parts:
        raise ValueError(f"{path} holds no triangles; accepted is a mesh with at least one face")
    vertices, faces, normals, colors, uv = _concatenate(parts)
    check_faces(faces, len(vertices))
    vertices, faces = _without_bad_vertices(path, vertices, faces)
    vertices = _recentred(path, vertices, faces)
    if path.suffix.lower() == ".stl":  # a triangle soup: weld it
        vertices, index = np.unique(vertices, axis=0, return_inverse=True)
        faces, normals, colors = index.reshape(-1)[faces], None, None
    if normals is None:
        source, faces, normals = _smooth_normals(vertices, faces, crease_degrees)
        vertices, colors, uv = (None if a is None else a[source] for a in (vertices, colors, uv))
    else:
        missing = ~(np.linalg.norm(np.nan_to_num(normals, posinf=0, neginf=0), axis=1) > 0)
        if missing.any():
            normals = np.where(missing[:, None], _smooth_normals(vertices, faces, None)[2], normals)
    return make_mesh(vertices, faces, normals=normals, colors=colors, uv=uv)


def load_points(path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Read a point cloud: PLY, or text (.xyz, .txt, .pts) with x y z or x y z nx ny nz in every line.

    Points that are NaN or infinite are dropped, and a warning counts them; clouds far from the origin are recentred as
    in `load_mesh`.

    Returns: points [N, 3], normals [N, 3] or None, colours [N, 3] linear RGB or None.
    Errors: FileNotFoundError; ValueError for another suffix, an unreadable file or no finite point.

    >>> points, normals, colors = se.load_points("cloud.ply")
    """
    path = _existing(path)
    suffix = path.suffix.lower()
    if suffix not in POINT_SUFFIXES:
        raise ValueError(f"{path} has the suffix {suffix!r}; accepted are point clouds {', '.join(POINT_SUFFIXES)}")
    points, normals, colors = _read_ply_points(path) if suffix == ".ply" else _read_text_points(path)
    good = np.isfinite(points).all(axis=1)
    if not good.any():
        raise ValueError(f"{path} holds no finite point; accepted is a cloud with at least one")
    if not good.all():
        warnings.warn(f"{path} holds {(~good).sum()} points that are NaN or infinite; they are dropped", stacklevel=2)
    points = points[good]
    normals, colors = (None if a is None else a[good] for a in (normals, colors))
    if normals is not None and not (np.linalg.norm(normals, axis=1) > 0).all():
        normals = None  # incomplete normals are estimated anew
    points = _recentred(path, points, np.arange(len(points)))
    normals, colors = (None if a is None else np.asarray(a, np.float32) for a in (normals, colors))
    return np.asarray(points, np.float32), normals, colors


def holds_points(path) -> bool:
    """Whether a file is a point cloud: by its suffix, or a PLY whose header tells of no faces."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix != ".ply" or not path.is_file():
        return suffix in POINT_SUFFIXES and suffix != ".ply"
    with path.open("rb") as file:
        header = file.read(1 << 16).partition(b"end_header")
    faces = re.search(rb"element\s+(?:face|tristrips)\s+(\d+)", header[0])
    return bool(header[1]) and (faces is None or int(faces[1]) == 0)


def _read_ply_points(path: Path):
    import trimesh

    try:
        cloud = trimesh.load(str(path), process=False)
    except (MemoryError, KeyboardInterrupt):
        raise
    except BaseException as error:  # trimesh lets whatever its parsers meet through
        raise ValueError(f"{path} cannot be read as a PLY point cloud: {_one_line(error)}") from None
    bodies = list(cloud.geometry.values()) if isinstance(cloud, trimesh.Scene) else [cloud]
    body: Any = bodies[0] if bodies else None
    if len(getattr(body, "vertices", ())) == 0:
        raise ValueError(f"{path} holds no points; accepted is a cloud with at least one")
    points = np.asarray(body.vertices, np.float64)
    rows = body.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = rows.dtype.names if getattr(rows, "dtype", None) is not None and rows.dtype.names else ()
    normals = None
    if {"nx", "ny", "nz"} <= set(names) and len(rows) == len(points):
        normals = np.nan_to_num(np.stack([np.asarray(rows[n], np.float64).reshape(-1) for n in ("nx", "ny", "nz")], -1))
    rgb = getattr(body, "colors", None)
    colors = None if rgb is None or len(rgb) != len(points) else codecs.srgb_decode(np.asarray(rgb)[:, :3] / 255)
    return points, normals, colors


def _read_text_points(path: Path):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as numbers: {_one_line(error)}") from None
    if table.shape[0] == 0 or table.shape[1] not in (3, 6):
        raise ValueError(
            f"{path} holds {table.shape[0]} lines of {table.shape[1]} numbers; accepted are 3 or 6 in a line"
        )
    return table[:, :3], np.nan_to_num(table[:, 3:]) if table.shape[1] == 6 else None, None


def _read_parts(path: Path) -> list[tuple]:
    """[(vertices, faces, normals, colors, uv)] of every body, in world space, float64."""
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(_io.StringIO()):
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(str(path), process=False)
    except (MemoryError, KeyboardInterrupt):
        raise
    except BaseException as error:  # trimesh lets whatever its parsers meet through
        raise ValueError(f"{path} cannot be read as a {path.suffix[1:].upper()} mesh: {_one_line(error)}") from None
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        body = scene.geometry[name]
        if not isinstance(body, trimesh.Trimesh) or len(body.faces) == 0:
            continue
        # Only normals that came with the file are cached at this point.
        normals = np.array(body.vertex_normals) if "vertex_normals" in body._cache.cache else None
        colors, uv = _appearance(body)
        vertices = np.asarray(body.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
        faces = np.asarray(body.faces, np.int64)
        if np.linalg.det(transform[:3, :3]) < 0:
            faces = faces[:, ::-1]
        if normals is not None:
            normals = normals @ np.linalg.pinv(transform[:3, :3])
        parts.append((vertices, faces, normals, colors, uv))
    return parts


def _appearance(body):
    """(linear vertex colours or None, uv or None)."""
    uv = getattr(body.visual, "uv", None)
    uv = None if uv is None or len(uv) != len(body.vertices) else np.asarray(uv, np.float64)
    if body.visual.kind not in ("vertex", "face"):
        return None, uv
    rgb = np.asarray(body.visual.vertex_colors, np.float64)[:, :3] / 255
    return codecs.srgb_decode(rgb), uv


def _concatenate(parts):
    """One set of arrays; where only some bodies have normals, colours or uv, the others get zero, white, zero."""
    offsets = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
    vertices = np.concatenate([p[0] for p in parts])
    faces = np.concatenate([p[1] + o for p, o in zip(parts, offsets, strict=True)])
    joined: list[np.ndarray | None] = []
    for k, fill, width in ((2, 0.0, 3), (3, 1.0, 3), (4, 0.0, 2)):
        if all(p[k] is None for p in parts):
            joined.append(None)
        else:
            joined.append(np.concatenate([np.full((len(p[0]), width), fill) if p[k] is None else p[k] for p in parts]))
    return vertices, faces, *joined


def _without_bad_vertices(path: Path, vertices, faces):
    bad = ~np.isfinite(vertices).all(axis=1)
    if not bad.any():
        return vertices, faces
    kept = faces[~bad[faces].any(axis=1)]
    text = f"{path} holds {bad.sum()} vertices that are NaN or infinite"
    if len(kept) == 0:
        raise ValueError(f"{text}, and every face uses one; accepted is a mesh with at least one finite face")
    warnings.warn(f"{text}; {len(faces) - len(kept)} faces that use them are dropped", stacklevel=3)
    return np.where(bad[:, None], 0.0, vertices), kept


def _recentred(path: Path, vertices, faces):
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    centre, extent = 0.5 * (low + high), float((high - low).max())
    if not np.abs(centre).max() > FAR_FROM_ORIGIN * extent or extent == 0:
        return vertices
    x, y, z = np.round(centre)
    warnings.warn(f"{path} lies far from the origin; it was moved by ({-x:g}, {-y:g}, {-z:g})", stacklevel=3)
    return vertices - np.round(centre)


def _smooth_normals(vertices, faces, crease_degrees):
    """Angle-weighted normals over equal positions, split at creases.

    Returns (file vertex of each vertex [V'], faces [F, 3], normals [V', 3]); without creases V' = V.
    """
    import trimesh

    _, position = np.unique(vertices, axis=0, return_inverse=True)
    position = position.reshape(-1)
    points = np.empty((position.max() + 1, 3))
    points[position] = vertices
    welded = trimesh.Trimesh(points, position[faces], process=False)
    group = welded.faces if crease_degrees is None else _smooth_groups(welded, crease_degrees)
    normals = trimesh.geometry.weighted_vertex_normals(
        vertex_count=max(group.max() + 1, len(points)),
        faces=group,
        face_normals=_face_normals(points[welded.faces]),
        face_angles=np.nan_to_num(welded.face_angles),
    )
    normals = np.nan_to_num(normals)
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0, normals, [0.0, 0.0, 1.0])
    if crease_degrees is None:
        return np.arange(len(vertices)), faces, normals[position]
    # A corner keeps its own file vertex (its uv and colour): the new vertices are (file vertex, group) pairs.
    corners = np.stack([faces.reshape(-1), group.reshape(-1)], axis=1)
    pairs, index = np.unique(corners, axis=0, return_inverse=True)
    return pairs[:, 0], index.reshape(-1, 3), normals[pairs[:, 1]]


def _smooth_groups(mesh, crease_degrees):
    """[F, 3]: corners at one vertex share a number when edges that bend less than the angle join their faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    smooth = mesh.face_adjacency_angles < np.deg2rad(crease_degrees)
    pairs, edges = mesh.face_adjacency[smooth], mesh.face_adjacency_edges[smooth]

    def corner(side, end):
        face, vertex = pairs[:, side], edges[:, end]
        return 3 * face + np.argmax(mesh.faces[face] == vertex[:, None], axis=1)

    first, second = (np.concatenate([corner(side, 0), corner(side, 1)]) for side in (0, 1))
    count = 3 * len(mesh.faces)
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1].reshape(-1, 3)


def _face_normals(corners):
    """Unit normals [F, 3]; zero for faces without area."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1)


# ------------------------------------------------------------------------------------------- environment maps, images


def load_environment(path) -> np.ndarray:
    """Read a latitude-longitude radiance map `[h, w, 3]`, linear RGB, float32 (SPEC 7).

    `.exr` needs the extra `shapeenh[exr]`; `.hdr` (RGBE) is read here; 8- and 16-bit images are taken as sRGB and
    decoded. Values are as in the file: `sample_environment` replaces negative and infinite ones.

    Errors: FileNotFoundError; ValueError for an unreadable file or one that is not an image of 1 or 3 channels.

    >>> lights = se.sample_environment(se.load_environment("studio.exr"), 54)
    """
    image = load_image(path, linear=True)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    return np.ascontiguousarray(image[..., :3], np.float32)


def load_image(path, *, linear: bool = False) -> np.ndarray:
    """Read an image `[h, w]` or `[h, w, C]`: uint8 or uint16 as in the file, float32 for EXR, HDR and float TIFF.

    With `linear`, integer images become linear float32 by the sRGB curve.

    Errors: FileNotFoundError; ValueError for an unreadable file.
    """
    path = _existing(path)
    data = path.read_bytes()
    suffix = path.suffix.lower()
    try:
        image = codecs.decode_image(data, suffix)
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:
        raise ValueError(f"{path} cannot be read as an image: {_one_line(error)}") from None
    if linear and np.issubdtype(image.dtype, np.integer):
        image = codecs.srgb_decode(image.astype(np.float64) / np.iinfo(image.dtype).max).astype(np.float32)
    return image


def load_height(path) -> tuple[np.ndarray, tuple[float, float] | None, float | None]:
    """Read a height field: (heights [h, w], cell size (dx, dy) or None, nodata value or None).

    A GeoTIFF tells its cell size and nodata value; other images do not. Of several channels the first is taken.

    Errors: FileNotFoundError; ValueError for an unreadable file.
    """
    image = load_image(path)
    path = Path(path)
    spacing, nodata = None, None
    if path.suffix.lower() in (".tif", ".tiff"):
        spacing, nodata = codecs.tiff_georeference(path.read_bytes())
    return image if image.ndim == 2 else image[..., 0], spacing, nodata


def save_image(path, image, *, bits: int = 8) -> None:
    """Write an image; the suffix says how.

    `.png`, `.jpg`: linear RGB floats are clipped to [0, 1] and encoded as sRGB, once, here; uint8 and uint16 arrays are
    written as they are. `.exr`, `.hdr`, `.tif`: linear floats, untouched.

    Args:
        path: the file; its folder must exist.
        image: [H, W], [H, W, 3] or [H, W, 4] (RGBA, alpha last, not sRGB-encoded).
        bits: 8 or 16, for PNG.

    Errors: FileNotFoundError for a missing folder; ValueError for another shape, suffix or NaN in an integer format.

    >>> se.save_image("out.png", se.render(mesh, camera, lights, material, height=600, width=800))
    """
    path = check_picture_path(path)
    path.write_bytes(codecs.encode_image(np.asarray(image), path.suffix.lower(), bits=bits))


def check_picture_path(path) -> Path:
    """A path that `save_image` can write to: a known suffix, an existing folder."""
    path = Path(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"{path} has the suffix {path.suffix!r}; accepted are pictures {', '.join(PICTURE_SUFFIXES)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the output folder {path.parent} does not exist")
    return path


def _existing(path) -> Path:
    path = Path(os.fspath(path))
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if not path.is_file():
        raise ValueError(f"{path} is not a file")
    return path


def _one_line(error: BaseException) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
