"""A sensor's file put into the world of a scenario."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from consistency.bench.scenario import ListedEffect, LocalBias, Scenario, UvdSensor, explain, read_table
from consistency.bench.scenario.truth_and_belief import with_changes
from consistency.bench.store.log import SensorFile
from consistency.bench.sweeps.axes import Changes
from consistency.referee.errors import InputError


def read_rig(path: Path, world: Scenario) -> Scenario:
    """Return ``world`` with the stereo sensor of a ``sensor.toml``, in truth and belief alike.

    What the file does not say is that of ``world``: odometry noise, image size and the range of disparities, both
    scaled to the file's focal length and baseline.

    Raises
    ------
    InputError
        The file is unreadable, of another sensor than the world's, or gives a scenario that cannot be.
    """
    file, camera = read_table(path, SensorFile), world.truth.sensor
    if file.model != camera.model or not isinstance(camera, UvdSensor):
        raise InputError(f"{path}: key 'model' is '{file.model}', the world's sensor is '{camera.model}'")
    assert file.f is not None
    assert file.B is not None
    f, B = camera.rig
    motion = file.motion or world.belief.motion
    image, disparity = file.image, file.disparity
    if image is None and camera.image is not None:
        width, height = (round(pixels * file.f / f) for pixels in camera.image)
        image = (width, height)
    if disparity is None:
        low, high = camera.disparity
        disparity = (low, high * file.f * file.B / (f * B))
    true_sensor = {
        "sigma": file.sigma,
        "f": file.f,
        "B": file.B,
        "image": image,
        "disparity": disparity,
        "principal_point": file.principal_point,
        "mount": file.mount.model_dump(),
        "disparity_growth": file.disparity_growth,
        "effects": _effects_with_bias(camera, file),
    }
    changes: Changes = {f"truth.sensor.{key}": value for key, value in true_sensor.items()}
    changes |= {
        "belief.sensor": file.belief().model_dump() | {"disparity": disparity},
        "belief.motion": motion.model_dump(),
        "belief.sigma_points": file.sigma_points.model_dump(),
        "truth.motion.sigma_v": motion.sigma_v,
        "truth.motion.sigma_omega": motion.sigma_omega,
    }
    try:
        return with_changes(world, path.stem, f"{path} in the world of {world.name}", changes)
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error, Scenario)}") from None


def _effects_with_bias(camera: UvdSensor, file: SensorFile) -> list[ListedEffect]:
    """Return the effects of the world's sensor with the biases of the file in place of its own."""
    effects = [effect for effect in camera.effects if not isinstance(effect, LocalBias)]
    if file.bias is None:
        return effects
    return [*effects, LocalBias.model_validate(file.bias.model_dump())]
