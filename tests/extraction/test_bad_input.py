"""What is no eye image gets a reason or one error of the user's; nothing else is ever raised, no number is ever NaN."""

from __future__ import annotations

import numpy as np
import pytest

import make_ideal_images as ideal
from eyerender.base.errors import InputError
from eyerender.base.status import Status
from eyerender.extraction import FAST, REFINED, Extraction, ExtractionSettings, extract


def _check(found: Extraction) -> None:
    """Every result is complete and consistent."""
    pupil = found.pupil
    assert 0.0 <= pupil.confidence <= 1.0
    if not pupil.ok:
        assert pupil.ellipse is None
        assert pupil.covariance is None
        assert pupil.reason is not None
        assert pupil.reason.startswith(f"{pupil.stage}: ")
        assert found.glints == ()
        return
    assert pupil.reason is None
    assert np.isfinite(pupil.covariance).all()
    assert np.linalg.eigvalsh(pupil.covariance).min() > -1e-9 * np.trace(pupil.covariance)
    assert np.isfinite(pupil.contour_px).all()
    assert pupil.contour_px.shape[0] >= 8
    height, width = found.shape
    # A pupil may be cut by the frame, but most of it must be seen.
    assert -0.5 * width < pupil.ellipse.centre_px[0] < 1.5 * width
    assert -0.5 * height < pupil.ellipse.centre_px[1] < 1.5 * height
    for value in pupil.goodness.__dataclass_fields__:
        assert np.isfinite(float(getattr(pupil.goodness, value)))
    for glint in found.glints:
        assert glint.ok
        assert np.isfinite(glint.xy_px).all()
        assert np.linalg.eigvalsh(glint.covariance).min() > 0.0
        assert glint.amplitude > 0.0
    for glint in found.rejected:
        assert glint.reason


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((240, 320), np.uint8), "all black"),
        (np.full((240, 320), 255, np.uint8), "all white"),
        (np.full((240, 320), 90, np.uint8), "one grey level"),
        (np.full((240, 320), 3.25), "one grey level"),
        (np.zeros((240, 320)), "no positive intensity"),
        (-np.ones((240, 320)), "no positive intensity"),
        (np.full((1, 1), 7, np.uint8), "1 x 1"),
        (np.arange(40, dtype=np.uint8).reshape(2, 20), "20 x 2"),
        (np.full((40, 40), np.nan), "not finite"),
        (np.where(np.eye(60) > 0, np.inf, 0.5), "not finite"),
        (np.broadcast_to(np.uint8(3), (9000, 9000)), "million pixels"),
        (np.where(np.eye(60) > 0, 1e308, 1e-300), ""),
    ],
)
def test_images_without_content_are_missing_with_the_reason(image, reason):
    found = extract(image)
    assert found.pupil.status == Status.NOT_FOUND
    assert reason in found.pupil.reason
    _check(found)


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (np.zeros((40, 40, 2), np.uint8), {}, r"has the shape \(40, 40, 2\)"),
        (np.zeros((40, 40, 3), bool), {}, r"has the shape \(40, 40, 3\)"),
        (np.zeros(40, np.uint8), {}, r"has the shape \(40,\)"),
        (np.zeros((4, 40, 40, 1), np.uint8), {}, "has the shape"),
        (np.zeros((0, 40), np.uint8), {}, "holds 0 values"),
        (np.zeros((40, 40), bool), {}, "type bool"),
        (np.zeros((40, 40), complex), {}, "type complex"),
        (np.array([["a", "b"]]), {}, "expected integers or floats"),
        ("picture.png", {}, "has the shape"),
        (np.full((40, 40), 300, np.uint16), {"bit_depth": 8}, "bit_depth: holds levels 300 to 300, outside the 8 bits"),
        (np.full((40, 40), -3, np.int16), {}, "bit_depth: holds levels -3"),
        (np.zeros((40, 40), np.uint32), {}, "bit_depth: must be between 1 and 16"),
        (np.zeros((40, 40), np.uint8), {"bit_depth": 0}, "bit_depth: must be between 1 and 16"),
        (np.zeros((40, 40), np.uint8), {"gamma": 0.0}, "gamma: must be between"),
        (np.zeros((40, 40), np.uint8), {"gamma": float("nan")}, "gamma: must be between"),
    ],
)
def test_what_is_no_single_channel_image_is_refused(image, options, message):
    with pytest.raises(InputError, match=message):
        extract(image, **options)


def test_settings_are_checked():
    with pytest.raises(InputError, match="radius_max_px must be > radius_min_px"):
        ExtractionSettings.from_mapping({"radius_min_px": 50.0, "radius_max_px": 20.0})
    with pytest.raises(InputError, match="unknown key"):
        ExtractionSettings.from_mapping({"radius": 3.0})


def test_images_without_an_eye():
    """Letters can be ellipses; everything else is turned down, and hardly an answer is a sure one."""
    sure = found = 0
    for seed in range(20_000, 20_060):
        pupil = extract(ideal.draw_no_eye(seed)).pupil
        found += pupil.ok
        sure += pupil.confidence > 0.9
    assert found <= 15
    assert sure <= 3


def test_outside_the_sizes_looked_for():
    image = ideal.draw("noise2-13px", 20_000).image
    wide = extract(image, settings=ExtractionSettings(radius_min_px=45.0)).pupil
    assert not wide.ok


def _cropped(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    y, x = (int(rng.integers(0, n)) for n in image.shape)
    return image[y : y + int(rng.integers(1, 200)), x : x + int(rng.integers(1, 200))]


def _painted(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = image.copy()
    y, x = (int(rng.integers(0, n)) for n in out.shape)
    out[y : y + 60, x : x + 90] = rng.integers(0, 255)
    return out


def _flipped(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    raw = bytearray(np.ascontiguousarray(image).tobytes())
    for place in rng.integers(0, max(len(raw), 1), 200 if raw else 0):
        raw[place] ^= int(rng.integers(1, 256))
    return np.frombuffer(bytes(raw), image.dtype).reshape(image.shape)


DAMAGES = (
    _cropped,
    lambda image, rng: np.iinfo(image.dtype).max - image if image.dtype.kind == "u" else -image,
    _painted,
    lambda image, rng: (image * rng.uniform(0.0, 1.0)).astype(image.dtype),
    lambda image, rng: image.astype(np.float64) / 255.0 * 10.0 ** rng.integers(-6, 7),
    lambda image, rng: image[:: int(rng.integers(1, 6)), :: int(rng.integers(1, 6))],
    _flipped,
    lambda image, rng: np.where(rng.random(image.shape) < 0.2, 0, image).astype(image.dtype),
    lambda image, rng: np.roll(image, int(rng.integers(0, 300)), axis=int(rng.integers(0, 2))),
    lambda image, rng: np.minimum(image, rng.integers(1, 60)).astype(image.dtype),
    lambda image, rng: np.sort(image, axis=int(rng.integers(0, 2))),
    lambda image, rng: np.repeat(np.repeat(image[:80, :80], 3, axis=0), 3, axis=1),
)


def _mutate(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, dict]:
    """One to three random damages, and sometimes a wrong description."""
    out = image
    for _ in range(rng.integers(1, 4)):
        out = DAMAGES[rng.integers(0, len(DAMAGES))](out, rng)
        if out.size == 0:
            return out, {}
    options: dict = {}
    if rng.random() < 0.2:
        options["gamma"] = float(rng.uniform(0.3, 3.0))
    if rng.random() < 0.1:
        options["bit_depth"] = int(rng.integers(1, 17))
    return out, options


def _fuzz(count: int, first: int) -> None:
    conditions = ["noise2-13px", "mixed", "remote", "edge-glint"]
    sources = [ideal.draw(name, 20_100 + i).image for i, name in enumerate(conditions)]
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 77])
        image, options = _mutate(sources[seed % len(sources)], rng)
        polarity = "bright" if rng.random() < 0.25 else "dark"
        settings = (FAST, REFINED)[seed % 2].model_copy(update={"polarity": polarity})
        try:
            found = extract(image, settings=settings, **options)
        except InputError:
            continue
        _check(found)


# The fits damp their steps against overflow themselves; a warning from numpy would be a number out of hand.
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_hundred_mutations():
    _fuzz(100, 0)


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_thousand_mutations():
    _fuzz(1000, 1000)
