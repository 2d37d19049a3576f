import numpy as np
import pytest
from scenes import cameras

from gimp3d.stages.exposure import exposure_ring, level_exposure
from gimp3d.stages.masks import ViewMasks

CAMERA = cameras(1)[0]
SHAPE = (CAMERA.height, CAMERA.width)


def view() -> ViewMasks:
    silhouette = np.zeros(SHAPE, bool)
    silhouette[30:60, 40:80] = True
    depth = np.full(SHAPE, 2.0, np.float32)
    return ViewMasks(
        CAMERA,
        silhouette,
        silhouette,
        np.zeros(SHAPE, bool),
        silhouette,
        depth,
        np.ones(SHAPE, np.float32),
        depth,
        np.ones(SHAPE, np.float32),
        silhouette.astype(np.float32),
    )


def drawn() -> np.ndarray:
    return np.random.default_rng(3).integers(40, 190, (*SHAPE, 3)).astype(np.uint8)


@pytest.mark.parametrize("gain", [0.8, 1.2, 1.3])
def test_another_exposure_is_taken_out_and_put_back(gain: float) -> None:
    noise = np.random.default_rng(4).normal(0, 3, (*SHAPE, 3))
    photo = np.clip(gain * drawn() + noise, 0, 255).astype(np.uint8)
    photo[30:60, 40:80] = (220, 10, 10)  # the object says nothing of the exposure
    photo[:, 82:90] = 0  # nor does what the splats do not have
    found = level_exposure(exposure_ring(view()), photo, drawn())
    np.testing.assert_allclose(found.gain, gain, rtol=0.02)
    changed = np.zeros(SHAPE, bool)
    changed[30:60, 40:80] = True
    back = found.back(drawn(), photo, changed)
    np.testing.assert_array_equal(back[~changed], photo[~changed])
    np.testing.assert_allclose(back[changed], gain * drawn()[changed].astype(float), atol=4 * gain + 1)


@pytest.mark.parametrize("noise", [0, 8])
def test_a_photo_of_the_splats_exposure_stays_bit_for_bit(noise: float) -> None:
    photo = np.clip(drawn() + np.random.default_rng(5).normal(0, noise, (*SHAPE, 3)), 0, 255).astype(np.uint8)
    found = level_exposure(exposure_ring(view()), photo, drawn())
    assert found.level(photo) is photo and (found.gain == 1).all()


def test_a_photo_of_something_else_is_left_as_it_is() -> None:
    photo = np.random.default_rng(6).integers(0, 255, (*SHAPE, 3)).astype(np.uint8)
    assert level_exposure(exposure_ring(view()), photo, drawn()).level(photo) is photo
    dark = (drawn() // 16).astype(np.uint8)
    assert level_exposure(exposure_ring(view()), dark, drawn()).level(dark) is dark
