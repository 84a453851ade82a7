"""`observe`: what the sensors of a rig measure in a scene."""

from collections.abc import Mapping
from typing import Any

import jax
from jaxtyping import Array

from splatax.cameras import Camera
from splatax.outputs import Rendering
from splatax.rendering import Renderer
from splatax.scene import Drawable
from splatax.sensors.protocol import Key, Sensor
from splatax.sensors.rig import CameraRig


def observe(
    scene: Drawable,
    rig: CameraRig | Camera,
    sensors: Mapping[str, Sensor],
    *,
    key: Key | None = None,
    renderer: Renderer = Renderer(),
) -> dict[str, Any]:
    """Returns the measurements of all sensors in all cameras of a rig.

    The sensors that look through the rig's cameras share one drawing of each view. The cameras are drawn by
    `vmap`. The function is traceable, and differentiable where the sensors are.

    Args:
        scene: Gaussians, or a `Scene` of parts, in metres for measurements in metres; see `in_metres`.
        rig: the cameras at their poses in the world, or one camera.
        sensors: what to measure, by names of your choice, such as {"depth": Depth()}.
        key: random key of the noise; None for measurements without noise.
        renderer: background, filter and backend.

    Returns:
        The measurements by the names of the sensors. Those of a rig have a leading axis, one entry for each
        camera.

    Raises:
        ValueError: if the scene does not fit a sensor; see `render` for further cases.
    """

    def one(camera: Camera, key: Key | None) -> dict[str, Any]:
        return _measured(scene, camera, sensors, key, renderer)

    if isinstance(rig, Camera):
        return one(rig, key)
    keys = None if key is None else jax.random.split(key, len(rig))
    return jax.vmap(one, in_axes=(0, None if keys is None else 0))(rig.cameras, keys)


def _measured(
    scene: Drawable, camera: Camera, sensors: Mapping[str, Sensor], key: Key | None, renderer: Renderer
) -> dict[str, Any]:
    """Returns the measurements of one camera."""
    views = {name: sensor.views(camera) for name, sensor in sensors.items()}
    sharing = [name for name, own in views.items() if len(own) == 1 and own[0] is camera]
    shared = _drawn(scene, camera, {name: sensors[name] for name in sharing}, renderer) if sharing else None
    keys = [None] * len(sensors) if key is None else list(jax.random.split(key, len(sensors)))
    readings = {}
    for (name, sensor), own_key in zip(sensors.items(), keys, strict=True):
        if shared is not None and name in sharing:
            drawn: tuple[Rendering, ...] = (_of(name, sensor, shared),)
        else:
            alone = {name: sensor}
            drawn = tuple(_of(name, sensor, _drawn(scene, view, alone, renderer)) for view in views[name])
        readings[name] = sensor.read(drawn, views[name], own_key)
    return readings


def _drawn(scene: Drawable, view: Camera, sensors: Mapping[str, Sensor], renderer: Renderer) -> Rendering:
    """Draws what some sensors need of one view."""
    outputs = dict.fromkeys(output for sensor in sensors.values() for output in sensor.outputs)
    features: dict[str, Array] = {
        f"{name}/{feature}": values
        for name, sensor in sensors.items()
        for feature, values in sensor.features(scene).items()
    }
    return renderer(scene, view, tuple(outputs), features)


def _of(name: str, sensor: Sensor, drawn: Rendering) -> Rendering:
    """Returns the part of a drawing that one sensor asked for."""
    own = {key.removeprefix(f"{name}/"): v for key, v in drawn.features.items() if key.startswith(f"{name}/")}
    return Rendering({output: drawn.images[output] for output in sensor.outputs}, own)
