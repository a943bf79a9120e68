"""The stages on images whose answer is known, and the chain's truth, labels and refusals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scripts import experiment

import consistency as cs
from consistency.stereo.rendered_images import chain as module
from consistency.stereo.rendered_images.chain import (
    DRIFTED,
    JUNCTION,
    KEPT,
    MISMATCH,
    NO_DISPARITY,
    POINT,
    REJECTED,
    Chain,
    Stops,
    Tracks,
    at_junction,
    join_tracks,
    pose_at,
    stage,
    stand,
    wall_texture,
)
from consistency.stereo.rendered_images.scene import (
    Camera,
    Layer,
    Lens,
    Plain,
    RandomTexture,
    Scene,
    StereoCamera,
    film,
)
from consistency.stereo.rendered_images.stages import (
    BlockMatching,
    GoodFeatures,
    Klt,
    KltAcross,
    KnownDisparity,
    KnownProjection,
    LeftRightCheck,
    PairObservations,
    SemiGlobal,
    Spread,
    TrackResidual,
    dissimilarity,
    patches,
)

pytest.importorskip("cv2")

drives = experiment("image_drives")

CAMERA = StereoCamera()
WRONG = StereoCamera(Camera(lens=Lens(0.005)), Camera(lens=Lens(-0.005), turned=(0.001, 0.002, 0.001)))


def wall(distance=2.0, seed=0):
    return Scene((Layer.facing(distance, RandomTexture.draw(np.random.default_rng(seed))),))


def pair(scene, noise=0.0, pose=None):
    frame = next(film(scene, CAMERA, [np.zeros(6) if pose is None else pose], np.random.default_rng(1), noise))
    return frame.left, frame.right


# --- stages ------------------------------------------------------------------------------------


@pytest.mark.parametrize("matcher, within", [(BlockMatching(), 0.15), (SemiGlobal(), 0.35), (KltAcross(), 0.05)])
def test_matchers_measure_the_disparity_of_a_wall(matcher, within):
    """f B / x = 6.75 px at 2 m; without noise, SGBM is drawn to whole pixels."""
    left, right = pair(wall())
    uv = np.stack(np.meshgrid(np.arange(-100, 101, 25.0), np.arange(-90, 91, 30.0)), axis=-1).reshape(-1, 2)
    d = matcher.measure(left, right, uv)
    assert np.isfinite(d).mean() > 0.9
    assert np.nanmax(np.abs(d - 6.75)) < within


@pytest.mark.parametrize("matcher", [BlockMatching((1, 5)), SemiGlobal((8, 20)), KltAcross((8, 32))])
def test_what_is_outside_the_search_is_not_found(matcher):
    left, right = pair(wall())
    assert np.isnan(matcher.measure(left, right, np.array([[20.0, 0.0], [60.0, 30.0]]))).all()


def test_a_tracker_follows_a_shift():
    """From 2 m, 0.02 m to the left: features move right by 1.5 px."""
    before, _ = pair(wall())
    after, _ = pair(wall(), pose=np.array([0.0, 0.02, 0.0, 0, 0, 0]))
    uv = GoodFeatures(30).choose(before)
    there, found = Klt(agreement=0.2).follow(before, after, uv, uv)
    assert found.all()
    assert_allclose(there - uv, np.tile([1.5, 0.0], (len(uv), 1)), atol=0.05)


def test_a_tracker_that_does_not_agree_with_itself_loses_the_feature():
    """The second image is of another wall."""
    before, after = pair(wall())[0], pair(wall(seed=9))[0]
    uv = GoodFeatures(30).choose(before)
    lax, strict = (Klt(agreement=value).follow(before, after, uv, uv)[1] for value in (None, 0.2))
    assert strict.sum() < 0.5 * lax.sum()


def test_features_are_spread_over_the_image():
    """Strong texture in one corner takes all features, unless they are spread."""
    corner = Layer.facing(2.0, RandomTexture.draw(np.random.default_rng(3), contrast=40.0), (1.3, 0.9), (1.2, 1.0))
    weak = Layer.facing(3.0, RandomTexture.draw(np.random.default_rng(4), contrast=6.0))
    image, _ = pair(Scene((weak, corner)))
    best, spread = GoodFeatures(20).choose(image), Spread(20, 5, 4, quality=0.001).choose(image)
    in_corner = [(uv[:, 0] < -20).mean() for uv in (best, spread)]
    assert len(best) == len(spread) == 20
    assert in_corner[0] > 0.9 > 0.6 > in_corner[1]
    cells = {(int(u // 64), int(v // 60)) for u, v in spread + np.array([160, 120])}
    assert len(cells) >= 18
    strongest = {}
    for u, v in GoodFeatures(0, quality=0.001).choose(image):
        strongest.setdefault((u + 160) // 64 + 5 * ((v + 120) // 60), (u, v))
    assert set(strongest.values()) <= set(map(tuple, spread))


def test_left_right_check_finds_what_only_one_image_sees():
    """Beside a near pole the left image shows wall that the right one does not."""
    near = Layer.facing(1.0, RandomTexture.draw(np.random.default_rng(5)), (-1 / 3, 0.0), (0.3, 9.0))
    left, right = pair(Scene((*wall(4.0).layers, near)), 2.0)
    # the pole is 45 px wide about u = 50 in the left image, 13.5 px further left in the right one: hidden are u from
    # 27.5 - 13.5 + 3.4 to 27.5; u = -45 is wall in both, and its mirror image is on the pole
    v = np.arange(-90.0, 91.0, 10.0)
    hidden, open_ = (np.stack([np.full(len(v), u), v], axis=-1) for u in (22.0, -45.0))
    shares = []
    for uv in (hidden, open_):
        d = BlockMatching().measure(left, right, uv)
        shares.append(
            LeftRightCheck().keep(PairObservations(left, right, uv, d, np.zeros(len(uv)), BlockMatching())).mean()
        )
    assert shares[0] < 0.5 < 0.9 < shares[1]


def test_dissimilarity_is_small_for_one_place_at_two_depths():
    image, other = pair(wall())[0], pair(wall(), pose=pose_at(0.4))[0]  # 2 m, then 1.6 m: 1.25 times as large
    uv = GoodFeatures(20).choose(image) * 0.5
    one = np.ones(len(uv))
    first = patches(image, uv, one)
    same, zoomed, not_zoomed = (
        dissimilarity(first, patches(other, 1.25 * uv, factor * one)) for factor in (1.0, 1.25, 1 / 1.25)
    )
    assert dissimilarity(first, first).max() < 1e-5
    assert np.median(zoomed) < 0.5 * np.median(same) < np.median(not_zoomed)
    evidence = PairObservations(image, image, uv, one, np.where(np.arange(len(uv)) % 2, 0.7, 0.5), BlockMatching())
    assert TrackResidual(0.6).keep(evidence).tolist() == [bool(k % 2 == 0) for k in range(len(uv))]


# --- the chain ---------------------------------------------------------------------------------


def test_without_stages_that_err_only_the_cameras_do():
    """Known projection and disparity: what is measured is what the cameras give, and with right ones the truth."""
    chain = Chain(tracking=KnownProjection(), correspondence=KnownDisparity())
    poses = np.stack([pose_at(0.1 * k) for k in range(4)])
    for camera in (CAMERA, WRONG):
        scene = wall()
        tracks = chain.run(film(scene, camera, poses, np.random.default_rng(2)), scene, camera)
        assert_allclose(tracks.z, tracks.real, atol=1e-6)
        if camera is CAMERA:
            assert_allclose(tracks.errors, 0.0, atol=1e-6)
        else:
            assert np.abs(tracks.errors).max() > 0.3


def test_truth_is_the_projection_of_the_feature_point_at_the_nominal_pose():
    """A feature at u in the first image, on a wall at 2 m, is at u 2 / (2 - s) after s m; d is 13.5 / (2 - s)."""
    poses = np.stack([pose_at(0.05 * k) for k in range(5)])
    actual = poses + np.array([0, 0, 0, 0, 0, 0.002])
    scene = wall()
    tracks = Chain().run(film(scene, CAMERA, actual, np.random.default_rng(3), 1.0, poses), scene, CAMERA)
    first = tracks.take(tracks.frame == 0)
    for frame in range(5):
        own = tracks.take(tracks.frame == frame)
        start = first.truth[np.searchsorted(first.track, own.track)]
        growth = 2.0 / (2.0 - 0.05 * frame)
        # turned by 2 mrad the feature's point is a little nearer or farther than a wall that faces the nominal pose
        assert_allclose(own.truth[:, 2], 13.5 / (2.0 - 0.05 * frame), rtol=1e-9)
        assert_allclose(own.truth[:, :2], growth * start[:, :2], rtol=1e-6)
        heading = own.errors[:, 0].mean()  # a heading to the left moves the image to the right
        assert heading == pytest.approx(0.3 * (1 + np.mean((own.truth[:, 0] / 150) ** 2)), abs=0.1)
        assert np.abs(own.z - own.real)[:, :2].max() < 0.8


def test_a_feature_that_comes_nearer_is_compared_at_its_size():
    """From 2 m to 1.4 m: patches zoomed by the measured disparity stay alike."""
    scene, poses = wall(), [pose_at(0.1 * k) for k in range(7)]
    tracks = Chain(tracking=KnownProjection()).run(
        film(scene, CAMERA, poses, np.random.default_rng(1), 1.0), scene, CAMERA
    )
    assert np.median(tracks.dissimilarity[tracks.frame == 6]) < 0.25


def test_tracks_say_which_observations_are_kept():
    chain = Chain(correspondence=BlockMatching((1, 7)), filters=(LeftRightCheck(), TrackResidual(-1.0)))
    scene = wall(2.2)
    poses = np.stack([pose_at(0.2 * k) for k in range(3)])  # 6.1, 6.75, 7.5 px: at last beyond the search
    tracks = chain.run(film(scene, CAMERA, poses, np.random.default_rng(4)), scene, CAMERA)
    assert (tracks.flag[tracks.frame < 2] == REJECTED).mean() > 0.9  # by the second filter, which keeps nothing
    assert (tracks.flag[tracks.frame == 2] == NO_DISPARITY).all()
    assert np.isnan(tracks.z[tracks.flag == NO_DISPARITY, 2]).all()
    assert len(tracks.kept) == (tracks.flag == KEPT).sum() == 0


def test_labels_tell_points_junctions_mismatches_and_drift(monkeypatch):
    scene, rng = wall(), np.random.default_rng(5)
    jump = np.array([0.0, 3.0])

    class Jumping:
        def follow(self, before, after, uv, true):
            return true + jump * (np.arange(len(uv)) == 0)[:, None], np.ones(len(uv), bool)

    class Wrong(KnownDisparity):
        def measure(self, left, right, uv):
            return np.where(np.arange(len(uv)) == 1, 9.75, 6.75)

    monkeypatch.setattr(module, "KnownDisparity", type("Other", (), {}))  # so that the chain asks the matcher
    tracks = Chain(tracking=Jumping(), correspondence=Wrong()).run(
        film(scene, CAMERA, [np.zeros(6)] * 2, rng), scene, CAMERA
    )
    labels = tracks.label[tracks.frame == 1]
    assert labels[:2].tolist() == [DRIFTED, MISMATCH]
    assert (labels[2:] == POINT).all()


def test_a_junction_is_where_two_depths_meet():
    near = Layer.facing(2.0, Plain(20.0), (0.0, 0.0), (0.4, 0.4))  # 30 px about the middle
    scene = Scene((Layer.facing(5.0, Plain(200.0)), near))
    uv = np.array([[15.0, 0.0], [15.0, 15.0], [0.0, 0.0], [40.0, 0.0], [15.0, 30.0]])
    assert at_junction(scene, CAMERA, np.zeros(6), uv).tolist() == [True, True, False, False, False]
    poster = Layer.facing(4.99, Plain(20.0), (0.0, 0.0), (1.0, 1.0))
    assert not at_junction(Scene((scene.layers[0], poster)), CAMERA, np.zeros(6), uv).any()


def test_the_crossing_of_a_pole_and_an_edge_is_no_rigid_point():
    """Tracked without error, a point fits to 1e-6 px; the crossing of edges at two depths does not.

    A point whose v is now 0.5 px too high and now too low is 0.35 px rms off over u and v.
    """
    poses = np.stack([pose_at(0.05 * k) for k in range(20)])
    depth = 4.0 - poses[:, 0], 2.5 - poses[:, 0]
    point = 150 * np.array([0.5, -0.3]) / depth[0][:, None]
    crossing = np.stack([150 * 0.5 / depth[1], -150 * 0.3 / depth[0]], axis=-1)
    shaky = point + np.stack([np.zeros(20), np.tile([0.5, -0.5], 10)], axis=-1)
    z = np.concatenate([np.column_stack([uv, 13.5 / depth[0]]) for uv in (point, crossing, shaky)])
    zero = np.zeros(60, int)
    tracks = Tracks(zero, np.tile(np.arange(20), 3), np.repeat([3, 8, 9], 20), z, z, z, zero, zero, zero)
    names, residual = drives.rigid_residual(tracks, poses, CAMERA)
    assert names.tolist() == [3, 8, 9]
    assert residual[0] < 1e-6
    assert residual[1] > 0.5
    assert residual[2] == pytest.approx(0.5 / np.sqrt(2), rel=0.1)
    assert np.isnan(drives.rigid_residual(tracks.take(tracks.frame < 2), poses, CAMERA)[1]).all()


def test_joined_tracks_keep_their_own_numbers():
    scene = wall()
    parts = [Chain().run(film(scene, CAMERA, [np.zeros(6)], np.random.default_rng(k)), scene, CAMERA) for k in range(2)]
    both = join_tracks(parts)
    assert len(np.unique(both.track)) == sum(len(np.unique(part.track)) for part in parts)
    assert both.sequence.tolist() == [0] * len(parts[0]) + [1] * len(parts[1])
    assert_array_equal(both.z, np.concatenate([part.z for part in parts]))


# --- protocols ---------------------------------------------------------------------------------


def test_the_stops_of_experiment_2():
    distances = Stops().distances
    assert len(distances) == 101
    assert_allclose(distances[[0, 1, -1]], [6.0, 5.95, 1.0])


def test_standing_does_not_depend_on_the_number_of_threads():
    stops = Stops(farthest=2.0, nearest=1.0, step=1.0, images=2)
    one, two = (stand(Chain(), CAMERA, stops, np.random.default_rng(6), workers) for workers in (1, 2))
    assert_array_equal(one.z, two.z)
    assert np.unique(one.sequence).tolist() == [0, 1]
    assert_allclose(one.truth[one.sequence == 1, 2], 13.5)
    assert np.unique(one.frame).tolist() == [0, 1, 2]


def test_a_retreat_goes_from_near_to_far():
    tracks = drives.retreat(Chain(), CAMERA, Stops(farthest=2.0, step=0.1), np.random.default_rng(7))
    d = [tracks.truth[tracks.frame == frame, 2] for frame in (0, 10)]
    assert_allclose(d[0], 13.5)
    assert_allclose(d[1], 6.75)


def test_shaking_turns_and_does_not_move():
    """2,000 poses: the sd within 6 standard errors (false alarm below 1e-8)."""
    turned = drives.shaken(np.zeros((2000, 6)), 0.01, np.random.default_rng(8))
    assert not turned[:, :3].any()
    assert_allclose(turned[:, 3:].std(axis=0), 0.01, rtol=6 / np.sqrt(4000))
    assert not drives.shaken(np.zeros((5, 6)), 0.0, np.random.default_rng(8)).any()


def test_scenes_have_depths_and_junctions(rng):
    tracks = drives.drive(Chain(Spread(30, 6, 5)), CAMERA, drives.office(rng), rng, images=3)
    assert np.ptp(tracks.truth[tracks.frame == 0, 2]) > 0.5
    scene = drives.partition(rng)
    tracks = drives.drive(Chain(Spread(40, 8, 5, 0.15), stereo_first=False), CAMERA, scene, rng, images=2)
    assert (tracks.label == JUNCTION).sum() > 5
    assert (tracks.label == POINT).sum() > 5
    assert wall_texture(rng).grey(np.zeros(3), np.zeros(3), 0.01).shape == (3,)


# --- bad input ---------------------------------------------------------------------------------


def test_stages_are_known_by_name():
    chain = Chain.of(
        "shi-tomasi",
        "none",
        "klt",
        ["left-right"],
        {"correspondence": {"window": 21}, "left-right": {"tolerance": 0.5}},
    )
    assert chain == Chain(GoodFeatures(), KnownProjection(), KltAcross(window=21), (LeftRightCheck(0.5),))


@pytest.mark.parametrize(
    "role, name, settings, message",
    [
        ("matching", "sgbm", {}, "no role 'matching'; known: selection, tracking, correspondence, filter"),
        ("tracking", "sift", {}, "no tracking 'sift'; known: klt, none"),
        (
            "correspondence",
            "block-matching",
            {"blocks": 9},
            "has no setting 'blocks'; known: search, block, uniqueness",
        ),
    ],
)
def test_a_stage_that_does_not_exist_is_refused(role, name, settings, message):
    with pytest.raises(cs.InputError, match=message):
        stage(role, name, settings)


def test_a_search_that_misses_the_scene_is_refused():
    scene = wall(2.0)
    with pytest.raises(cs.InputError, match=r"search: 8 to 32 px misses every depth .* from 6\.8 to 6\.8 px; widen"):
        Chain(correspondence=BlockMatching((8, 32))).run(
            film(scene, CAMERA, [np.zeros(6)], np.random.default_rng()), scene, CAMERA
        )
    with pytest.raises(cs.InputError, match=r"search: \(5, 5\), allowed is"):
        BlockMatching((5, 5)).measure(*pair(scene), np.zeros((1, 2)))


def test_an_image_that_is_too_small_is_refused():
    small = np.zeros((20, 30), np.uint8)
    with pytest.raises(cs.InputError, match="30 x 20 px is too small for blocks of 15 px and the search"):
        BlockMatching().measure(small, small, np.zeros((1, 2)))
    with pytest.raises(cs.InputError, match="too small for blocks of 5 px"):
        SemiGlobal().measure(small, small, np.zeros((1, 2)))
    with pytest.raises(cs.InputError, match="too small for the tracker's window of 21 px, which needs 23 px"):
        Klt(21).follow(small, small, np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(cs.InputError, match="too small for the margin of the selection"):
        GoodFeatures().choose(small)


def test_no_frames_are_refused():
    with pytest.raises(cs.InputError, match="frames: there is none"):
        Chain().run([], wall(), CAMERA)
