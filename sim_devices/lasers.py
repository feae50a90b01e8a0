"""All lasers that can be emulated, by the names under which `umfeld sim --laser` and configurations know them."""

from __future__ import annotations

from sim_devices.device import ByteDevice, Mount, Scene
from sim_devices.laser_hokuyo import PROFILES, HokuyoLaser, LaserProfile
from sim_devices.laser_ldrobot import LDROBOT_PROFILES, LdLidar
from sim_devices.laser_rplidar import RPLIDAR_PROFILES, RpLidar
from sim_devices.laser_sick_cola import COLA_PROFILES, SickColaLaser
from sim_devices.laser_sick_lms2xx import LMS2XX_PROFILES, SickLms2xxLaser

FIRST_MODEL = {
    "hokuyo": "utm-30lx",
    "sick_lms2xx": "lms200",
    "rplidar": "rplidar-a1",
    "ldrobot": "ld06",
    "sick_cola": "tim571",
}
MODELS: dict[str, str] = {
    **dict.fromkeys(PROFILES, "hokuyo"),
    **dict.fromkeys(LMS2XX_PROFILES, "sick_lms2xx"),
    **{f"rplidar-{name}": "rplidar" for name in RPLIDAR_PROFILES},
    **dict.fromkeys(LDROBOT_PROFILES, "ldrobot"),
    **dict.fromkeys(COLA_PROFILES, "sick_cola"),
}
"""Model -> driver."""


def make_laser(
    model: str,
    scene: Scene,
    mount: Mount,
    *,
    seed: int = 0,
    number: int = 0,
    exact: bool = False,
    profile: LaserProfile | None = None,
    on_tcp: bool = False,
) -> ByteDevice:
    """An emulated laser of a model of MODELS.

    number: tells several of one robot apart, in their serial numbers.  exact: no noise.  profile: a Hokuyo's, if it is
    not the model's.  on_tcp: a Hokuyo that is attached by Ethernet.
    """
    noise_scale = 0.0 if exact else 1.0
    match MODELS[model]:
        case "sick_lms2xx":
            return SickLms2xxLaser(
                scene, mount, profile=LMS2XX_PROFILES[model], seed=seed, noise_scale=noise_scale, boot_s=0.5
            )
        case "rplidar":
            told = RPLIDAR_PROFILES[model.removeprefix("rplidar-")]
            serial = bytes((0xAA, 0x55, told.model, number)) + bytes(range(1, 13))
            return RpLidar(scene, mount, profile=told, serial=serial, seed=seed, noise_scale=noise_scale)
        case "ldrobot":
            return LdLidar(scene, mount, profile=LDROBOT_PROFILES[model], seed=seed, noise_scale=noise_scale)
        case "sick_cola":
            cola = COLA_PROFILES[model]
            return SickColaLaser(
                scene, mount, profile=cola, serial=cola.serial + number, seed=seed, noise_scale=noise_scale
            )
    hokuyo = profile if profile is not None else PROFILES[model]
    return HokuyoLaser(
        scene,
        mount,
        profile=hokuyo,
        serial=f"{hokuyo.serial[:-1]}{number}" if number else None,
        seed=seed,
        link="tcp" if on_tcp else "usb",
        noise_scale=noise_scale,
    )
