"""Rendered images: where things are in them, against exact geometry."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import consistency as cs
from consistency.referee.geometry import rotation
from consistency.stereo.rendered_images.scene import (
    Blobs,
    Camera,
    Layer,
    Lens,
    Plain,
    RandomTexture,
    Scene,
    StereoCamera,
    digitised,
    film,
    render,
    render_pair,
    to_camera,
)

WRONG = StereoCamera(Camera(lens=Lens(0.01)), Camera(lens=Lens(-0.01, 0.002), turned=(0.004, -0.003, 0.002)))
POSE = np.array([0.1, 0.05, -0.02, 0.01, 0.02, -0.03])


def centroid(image, camera, start, ground):
    """Of a dark spot, weighted by a Gaussian window that moves with it."""
    column, row = np.rint(start + np.array([159.5, 119.5])).astype(int)
    near = slice(row - 14, row + 15), slice(column - 14, column + 15)
    dark, pixels, place = ground - image[near], camera.pixels[near], start
    for _ in range(60):
        weight = dark * np.exp(-0.5 * np.square((pixels - place) / 3.5).sum(axis=-1))
        place = (weight[..., None] * pixels).sum(axis=(0, 1)) / weight.sum()
    return np.asarray(place)


@pytest.mark.parametrize("camera", [StereoCamera(), WRONG], ids=["ideal", "wrong"])
@pytest.mark.parametrize("slant, radius", [(0.0, 0.03), (0.3, 0.012)])
def test_spots_are_where_their_centres_are_projected(camera, slant, radius):
    """To 0.01 px; on a slanted wall to 0.02, for a spot is askew there by the square of its size."""
    texture = Blobs.draw(np.random.default_rng(1), cell=0.5, radius=radius)
    scene = Scene((Layer.facing(2.0, texture, slant=slant),))
    pair = render_pair(scene, camera, POSE)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(-3, 3), np.arange(-2, 2)))
    a, b = texture.centres(i, j).T
    points = to_camera(POSE, scene.layers[0].points(a, b))
    worst = []
    for image, side, own in zip(pair, (camera.left, camera.right), (points, points - camera.offset), strict=True):
        for place in side.project(own):
            if np.all(np.abs(place) < (135, 95)):
                worst.append(np.abs(centroid(image, side, place, texture.ground) - place).max())
    assert len(worst) > 15
    assert max(worst) < (0.01 if slant == 0.0 else 0.02)


def test_a_triplet_is_that_of_the_chapter():
    """Eq. 22 by hand, and both cameras agree with it when nothing is wrong with them."""
    camera, points = StereoCamera(), np.array([[3.0, 0.4, -0.2], [1.5, -0.3, 0.5]])
    x, y, z = points.T
    expected = np.stack([-150 * y / x, -150 * z / x, 13.5 / x], axis=-1)
    assert_allclose(camera.ideal(points), expected, rtol=1e-12)
    assert_allclose(camera.real(points), expected, rtol=1e-9)


@pytest.mark.parametrize("camera", [WRONG.left, WRONG.right, Camera(lens=Lens(-0.25, 0.06))])
def test_rays_lead_to_where_points_are_projected(camera):
    uv = np.random.default_rng(2).uniform((-150, -110), (150, 110), (50, 2))
    assert_allclose(camera.project(3.0 * camera.rays(uv)), uv, atol=1e-8)


def test_distortion_as_it_is_defined():
    lens, m = Lens(0.1, 0.02), np.array([[0.6, -0.8], [0.0, 0.0]])
    assert_allclose(lens.distort(m), [[0.6 * 1.12, -0.8 * 1.12], [0, 0]])
    assert_allclose(lens.undistort(lens.distort(m)), m, atol=1e-12)


def test_a_rectification_that_knows_the_lens_leaves_nothing():
    glass = Lens(-0.25, 0.06)
    known, bare = Camera(lens=glass, corrected=glass), Camera()
    assert_allclose(known.field, bare.field, atol=1e-9)
    off = Camera(lens=glass, corrected=Lens(-0.245, 0.06))
    assert np.abs(off.field - bare.field).max() > 0.005


def test_a_turned_camera_sees_a_point_elsewhere():
    """A heading of +1 mrad moves what is ahead to the right by 0.15 px, a pitch of +1 mrad upwards."""
    point = np.array([[2.0, 0.0, 0.0]])
    u, _ = Camera(turned=(0.0, 0.0, 1e-3)).project(point)[0]
    _, v = Camera(turned=(0.0, 1e-3, 0.0)).project(point)[0]
    assert u == pytest.approx(0.15, rel=1e-5)
    assert v == pytest.approx(-0.15, rel=1e-5)


def test_near_layers_hide_far_ones():
    near = Layer.facing(2.0, Plain(200.0), (0.2, 0.1), (0.4, 0.2))
    scene = Scene((Layer.facing(5.0, Plain(50.0)), near))
    image = render(scene, Camera(), np.zeros(6))
    # 0.4 m wide and 0.2 m high at 2 m: 30 x 15 px about u = -15, v = -7.5; covered pixels count in full
    assert (image - 50.0).sum() / 150.0 == pytest.approx(30 * 15, rel=1e-3)
    row, column = np.indices(image.shape)
    weight = image - 50.0
    assert (weight * (column - 159.5)).sum() / weight.sum() == pytest.approx(-15.0, abs=0.01)
    assert (weight * (row - 119.5)).sum() / weight.sum() == pytest.approx(-7.5, abs=0.01)
    points, layer = scene.seen(np.zeros(6), Camera().rays(np.array([[-15.0, -7.5], [40.0, 0.0]])))
    assert layer.tolist() == [1, 0]
    assert_allclose(points[:, 0], [2.0, 5.0])


def test_a_layer_is_found_wherever_it_is():
    """A pole thinner than the grid by which layers are found, at every place, leaves its whole width in the image."""
    for u in np.arange(-100.0, 100.0, 13.7):
        pole = Layer.facing(3.0, Plain(200.0), (float(-3.0 * u / 150.0), 0.0), (0.04, 9.0))
        image = render(Scene((Layer.facing(5.0, Plain(50.0)), pole)), Camera(), np.zeros(6))
        assert_allclose((image - 50.0).sum(axis=1) / 150.0, 2.0, rtol=1e-3)


def test_what_is_behind_the_camera_is_not_seen():
    scene = Scene((Layer.facing(-2.0, Plain(200.0)),))
    assert (render(scene, Camera(), np.zeros(6)) == 128.0).all()
    assert (scene.seen(np.zeros(6), Camera().field.reshape(-1, 3))[1] == -1).all()


def test_a_texture_is_band_limited_and_blurred():
    """No octave is seen whose wavelengths are below two pixels; blur weakens and never adds."""
    texture = RandomTexture.draw(np.random.default_rng(3))
    line = np.linspace(0.0, 5.0, 4000)
    sharp, dull = (texture.grey(line, 0.3 * line, blur) for blur in (0.0, 0.02))
    assert sharp.std() > 1.3 * dull.std() > 5.0
    image = render(Scene((Layer.facing(6.0, texture),)), Camera(), np.zeros(6))
    power = np.abs(np.fft.fft2((image - image.mean()) * np.outer(np.hanning(240), np.hanning(320)))) ** 2
    high = np.hypot(np.fft.fftfreq(240)[:, None], np.fft.fftfreq(320)[None]) > 0.45
    assert power[high].sum() < 1e-3 * power.sum()


def test_grey_noise_has_its_standard_deviation():
    """76,800 pixels: sd 3 and a twelfth for rounding, within 6 standard errors (false alarm 2e-9)."""
    image = digitised(np.full((240, 320), 100.0), 3.0, np.random.default_rng(4)).astype(float)
    assert image.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=6 / np.sqrt(2 * image.size))
    assert digitised(np.array([[-5.0, 300.0]]), 0.0, np.random.default_rng()).tolist() == [[0, 255]]


def test_a_film_draws_noise_anew_and_takes_poses_as_they_are():
    scene = Scene((Layer.facing(2.0, Blobs.draw(np.random.default_rng(5))),))
    poses, nominal = np.zeros((3, 6)), np.ones((3, 6))
    poses[2, 0] = 0.5
    frames = list(film(scene, StereoCamera(), poses, np.random.default_rng(6), 2.0, nominal))
    first, second, third = (frame.left.astype(float) for frame in frames)
    assert 2.5 < (first - second).std() < 3.2  # sqrt(2) times the noise
    assert (first - third).std() > 5.0
    assert frames[1].nominal.tolist() == [1.0] * 6


def test_a_pose_is_applied_as_everywhere():
    points = np.array([[2.0, 0.5, 0.1]])
    world = points @ rotation(*POSE[3:]).T + POSE[:3]
    assert_allclose(to_camera(POSE, world), points, atol=1e-12)


def test_bad_input_is_said():
    with pytest.raises(cs.InputError, match=r"folds the image at 1\.33 times the focal length"):
        _ = Camera(lens=Lens(-0.4)).field
    with pytest.raises(cs.InputError, match="give both cameras the same"):
        StereoCamera(Camera(), Camera(f=160.0))
    with pytest.raises(cs.InputError, match="has no layer"):
        Scene(())


def test_blur_spreads_a_spot_and_keeps_its_sum():
    """2 pi radius^2 times the depth of a spot, however wide the point spread is."""
    texture = Blobs(np.zeros((1, 1, 2)), cell=1.0, radius=0.05, depth=90.0)
    grid = np.linspace(0.0, 1.0, 200, endpoint=False)
    a, b = (axis.ravel() for axis in np.meshgrid(grid, grid))
    for blur in (0.0, 0.03, 0.06):
        dark = (texture.ground - texture.grey(a, b, blur)).sum() / len(a)
        assert dark == pytest.approx(90.0 * 2.0 * np.pi * 0.05**2, rel=1e-3)
