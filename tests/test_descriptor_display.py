"""Legend of the colour scale, and line integral convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.descriptor.display import curvature_scale


def test_legend_shows_the_scale():
    """Its bar holds the colours of the scale, concave at the top; the ticks stand at the quarters."""
    legend = se.curvature_legend(300, scale=0.2)
    assert legend.shape[0] == 300
    assert legend.min() >= 0
    assert legend.max() <= 1
    column = legend[:, 8]
    bar = np.flatnonzero(column[:, 0] != column[:, 2])
    middle = (bar[0] + bar[-1]) // 2
    np.testing.assert_allclose(column[bar[0]], curvature_scale(jnp.asarray(1.0)), atol=0.02)
    np.testing.assert_allclose(column[bar[-1]], curvature_scale(jnp.asarray(-1.0)), atol=0.02)
    np.testing.assert_allclose(column[middle], 1, atol=0.02)
    ticks = np.flatnonzero((legend[:, 15] == 0).all(-1))
    assert len(ticks) == 5
    np.testing.assert_allclose(np.diff(ticks), (bar[-1] - bar[0]) / 4, atol=1.5)
    assert not np.array_equal(legend, se.curvature_legend(300, scale=0.4))  # other numbers
    np.testing.assert_array_equal(se.curvature_legend(300), se.curvature_legend(300, scale=0.2))
    for bad in ({"height": 10}, {"height": 100, "scale": 0.0}):
        with pytest.raises(ValueError, match=list(bad)[-1]):
            se.curvature_legend(**bad)


def correlation(image, down, right):
    """Of pixels and their neighbours at an offset."""
    a = image[: image.shape[0] - down, : image.shape[1] - right]
    return np.corrcoef(a.ravel(), image[down:, right:].ravel())[0, 1]


def test_strokes_follow_the_field(dtype):
    """Along the field neighbours look alike, across it they do not; the sign of the direction says nothing."""
    rng = np.random.default_rng(0)
    for direction, along, across in (((1, 0), (0, 3), (3, 0)), ((0, 2), (3, 0), (0, 3)), ((1, -1), (3, 3), None)):
        signs = rng.choice([-1.0, 1.0], (48, 64, 1))
        field = jnp.asarray(signs * np.array(direction, float), dtype)
        strokes = se.line_integral_convolution(field, length=20.0)
        assert strokes.dtype == dtype
        strokes = np.asarray(strokes)
        assert strokes.min() >= 0
        assert strokes.max() <= 1
        assert correlation(strokes, *along) > 0.6
        if across is not None:
            assert abs(correlation(strokes, *across)) < 0.25


def test_strokes_end_at_the_mask_and_where_there_is_no_direction():
    field = np.zeros((20, 30, 2), np.float32)
    field[..., 0] = 1
    mask = np.ones((20, 30), bool)
    mask[:, 15] = False
    noise = np.zeros((20, 30), np.float32)
    noise[:, 16:] = 1
    strokes = np.asarray(se.line_integral_convolution(field, mask=mask, noise=noise, length=30.0))
    np.testing.assert_array_equal(strokes[:, :15], 0)  # nothing crosses
    np.testing.assert_array_equal(strokes[:, 15:], 1)  # the gap itself, off the mask, is white
    field[:, 7] = 0
    field[3, 3] = np.nan
    assert np.isfinite(np.asarray(se.line_integral_convolution(field, mask=mask))).all()
    assert not np.asarray(jax.grad(lambda f: jnp.sum(se.line_integral_convolution(f)))(jnp.asarray(field))).any()
    for bad in ({"length": 0.0}, {"noise": np.zeros((3, 3))}, {"mask": np.ones((2, 2))}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            se.line_integral_convolution(field, **bad)
