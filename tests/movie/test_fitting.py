"""The fit of an outline to images whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import ncx2

from en4dvar_movie.fitting import fit_outline
from en4dvar_movie.outline import Circle, Optics, Outline
from en4dvar_movie.uncertainty import errors_of

CONTRAST = -0.5


def image(radii, width, rng, noise=0.05, side=64):
    y, x = np.indices((side, side)) - (side - 1) / 2 - 0.3
    r = np.hypot(x, y)
    shade = np.mean([ndtr((R - r) / width) for R in np.atleast_1d(radii)], axis=0)
    return (CONTRAST * shade + noise * rng.standard_normal(r.shape)).astype(np.float32)


def fits(R, width, count=60):
    rng = np.random.default_rng(8)
    start, optics = Circle(31.8, 31.8, R + 0.4), Optics(CONTRAST, width, 0.002)
    return [fit_outline(image(R, width, rng), start, optics)[0] for _ in range(count)]


@pytest.mark.parametrize(("R", "width"), [(14.0, 3.0), (14.0, 1.2), (22.0, 3.0), (40.0, 1.2)])
def test_sectors_scatter_as_pixels_do_where_noise_is_white(R, width):
    """What the fit takes out of the sums over sectors is given back, for sharp and blurred, whole and cut outlines."""
    assert np.mean([o.ratio for o in fits(R, width)]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("R", "width"), [(14.0, 1.2), (22.0, 3.0), (40.0, 1.2)])
def test_the_error_is_that_of_repeated_images(R, width):
    found = fits(R, width)
    off = np.array([o.circle.R for o in found]) - R
    stated = np.sqrt(np.mean([o.variance for o in found]))
    assert off.std() / stated == pytest.approx(1.0, abs=0.3)
    assert abs(off.mean()) < 3 * stated / np.sqrt(len(off)) + 0.005


@pytest.mark.parametrize(("R", "width"), [(2.5, 1.2), (2.9, 1.2), (4.5, 1.2), (6.0, 2.0), (9.0, 3.0)])
def test_what_blur_takes_from_a_disc_is_given_back(R, width):
    """The disc of which light is moved by a normal distance shows at r what a noncentral χ² says."""
    y, x = np.indices((48, 48)) - 23.2
    shade = ncx2.cdf((R / width) ** 2, 2, (x**2 + y**2) / width**2)
    optics = Optics(CONTRAST, width, 0.002)
    noise = 1e-4 * np.random.default_rng(5).standard_normal(shade.shape)
    disc = fit_outline((CONTRAST * shade + noise).astype(np.float32), Circle(23.0, 23.0, R), optics)[0]
    assert errors_of([disc], optics)[0].radius == pytest.approx(R, abs=0.02)
    inwards = R - disc.circle.R
    assert inwards > 0.4 * width**2 / R


@pytest.mark.parametrize(("R", "width", "ends"), [(12.0, 1.2, 0.65), (16.0, 1.5, 0.7), (16.0, 2.0, 0.7)])
def test_a_bright_centre_that_ends_gradually_is_no_smaller_contrast(R, width, ends):
    """As of a fit of one that ends sharply: it read these radii 0.09 to 0.2 pixels too large."""
    r = np.hypot(*(np.indices((64, 64)) - 31.2))
    shade = ndtr((R - r) / width) * (1 - 0.8 * np.exp(-((r / (ends * R)) ** 4)))
    light = CONTRAST * shade + 0.005 * np.random.default_rng(5).standard_normal(r.shape)
    lens = fit_outline(light.astype(np.float32), Circle(31.0, 31.0, R), Optics(CONTRAST, width, 0.05))[0]
    assert abs(lens.circle.R - R) < 0.03


@pytest.mark.parametrize(("R", "inner"), [(16.0, 0.85), (20.0, 0.85), (16.0, 0.8)])
def test_a_bright_centre_may_reach_far_out(R, inner):
    """As of a ring: these radii were 0.23, 0.15 and 0.09 pixels too large."""
    r = np.hypot(*(np.indices((80, 80)) - 39.2))
    shade = ndtr((R - r) / 1.1) - 0.9 * ndtr((inner * R - r) / 1.1)
    light = CONTRAST * shade + 0.005 * np.random.default_rng(5).standard_normal(r.shape)
    ring = fit_outline(light.astype(np.float32), Circle(39.0, 39.0, R), Optics(CONTRAST, 1.1, 0.05))[0]
    assert abs(ring.circle.R - R) < 0.03


def test_nested_circles_and_their_errors():
    rng = np.random.default_rng(9)
    radii = np.array([25.0, 21.0, 15.0])
    optics = Optics(CONTRAST, 1.2, 0.002)
    found = [fit_outline(image(radii, 1.2, rng), Circle(32.3, 31.5, 20.0), optics, 3) for _ in range(30)]
    off = np.array([[o.circle.R for o in one] for one in found]) - radii
    stated = np.sqrt(np.mean([[o.variance for o in one] for one in found], axis=0))
    assert np.all(np.abs(off.mean(axis=0)) < 3 * stated / np.sqrt(len(found)) + 0.005)
    assert np.all((off.std(axis=0) / stated > 0.65) & (off.std(axis=0) / stated < 1.4))


def test_nothing_fits_an_image_of_noise():
    noise = image(1e-9, 1.0, np.random.default_rng(1))
    found = fit_outline(noise, Circle(30, 30, 12), Optics(CONTRAST, 1.2, 0.002))
    assert found is None or abs(found[0].contrast) < 0.2 or found[0].circle.R < 3


def test_curvature_in_time_over_the_exposure_is_an_error():
    """Of R = a t² over an exposure of T frames the mean is a T²/12 above the middle, by integration."""
    a, T = 0.8, 0.5
    outlines = [
        Outline(Circle(0, 0, 20 + a * t**2), 1.2, CONTRAST, 0.01, np.zeros((2, 0)), 1e-6, 1.0, 0.0, 0.0, 1.0)
        for t in np.arange(-3.0, 4.0)
    ]
    still, moving = (errors_of(outlines, Optics(CONTRAST, 1.2, 0.002), share)[3].std for share in (0.0, T))
    sample = np.linspace(-T / 2, T / 2, 100_001)
    assert np.sqrt(moving**2 - still**2) == pytest.approx(np.mean(a * sample**2), rel=1e-3)


def test_modes_of_the_shape_and_their_error_are_those_that_were_drawn():
    """A_2 and B_2 of an ellipse at 30 degrees, B_3, and no mode 4; errors over their std have the std 1."""
    rng, optics, width = np.random.default_rng(11), Optics(CONTRAST, 1.2, 0.002), 1.2
    y, x = np.indices((64, 64)) - 31.8
    angle = np.arctan2(y, x)
    rho = 20 + 0.6 * np.cos(2 * (angle - np.deg2rad(30))) + 0.3 * np.sin(3 * angle)
    shade = CONTRAST * ndtr((rho - np.hypot(x, y)) / width)
    truth = np.array([[0.3, 0.0, 0.0], [0.6 * np.sin(np.pi / 3), 0.3, 0.0]])
    found = [
        fit_outline((shade + 0.05 * rng.standard_normal(x.shape)).astype(np.float32), Circle(31.5, 32, 20.3), optics)[0]
        for _ in range(40)
    ]
    off = [(o.modes[:, :3] - truth) / errors_of([o], optics)[0].mode_std for o in found]
    assert np.std(off) == pytest.approx(1.0, abs=0.2)
    assert np.mean([o.angle for o in found]) == pytest.approx(30, abs=1)
    assert np.mean([o.amplitude(2) for o in found]) == pytest.approx(0.6, abs=0.02)
