"""Settings of the three Deformable scenes: no value stands here, all stand in ``conf/data_gen/deformable_*/``."""

from dataclasses import dataclass

from omegaconf import MISSING

from data_gen.deformable.shapes import shapes
from data_gen.scene_settings import SceneSettings, require
from data_gen.settings import did_you_mean

SOLVERS = ("CG", "Newton")


@dataclass
class BodySettings:
    """Which soft bodies there are, what they are made of and how finely they are meshed."""

    count: int = MISSING  # bodies per trajectory
    shapes: list[str] = MISSING  # the pool; drawn without repetition where it is large enough
    colors: dict[str, list[float]] = MISSING  # sRGB in [0, 1], by shape
    spacing: float = MISSING  # of the mesh, m
    skin: float = MISSING  # m; contacts begin and the body is drawn this far outside its mesh
    density: float = MISSING  # kg/m3
    young: float = MISSING  # stiffness: Young's modulus, Pa
    poisson: float = MISSING  # Poisson's ratio
    damping: float = MISSING  # s, Rayleigh damping of the material


@dataclass
class ContactSettings:
    """Contacts of bodies with the floor and with each other, in MuJoCo's terms."""

    friction: float = MISSING
    solref: list[float] = MISSING  # time constant in s, damping ratio
    solimp: list[float] = MISSING  # impedance at first touch, impedance when deep, width in m
    solver: str = MISSING  # CG | Newton
    tolerance: float = MISSING
    iterations: int = MISSING


@dataclass
class DropSettings:
    """The initial state, at rest: each body turned at random, one above the other."""

    offset: float = MISSING  # m; largest distance of a body's centre from the vertical axis, along x and along y
    gap_min: float = MISSING  # m; between a body's lowest point and the highest one below it (or the floor)
    gap_max: float = MISSING
    highest: float = MISSING  # m; no point starts above
    max_speed: float = MISSING  # m/s; a faster vertex means that the simulation failed
    max_attempts: int = MISSING  # draws of the initial state before giving up on failing simulations


@dataclass
class FloorSettings:
    """A square floor at z = 0 with a soft checker pattern, and what is seen beyond it."""

    half_size: float = MISSING  # m
    color: list[float] = MISSING  # sRGB in [0, 1]
    contrast: float = MISSING  # amplitude of the pattern, in sRGB
    tile: float = MISSING  # side of a tile, m
    background: list[float] = MISSING


@dataclass
class LightSettings:
    """One directional light with a cast shadow, and ambient light."""

    direction: list[float] = MISSING  # where the light travels
    ambient: float = MISSING
    diffuse: float = MISSING
    shadow_size: int = MISSING  # pixels of the shadow map's side


@dataclass
class DeformableSettings(SceneSettings):
    """Everything that decides what is in the data set (with the seed)."""

    bodies: BodySettings = MISSING
    contact: ContactSettings = MISSING
    drop: DropSettings = MISSING
    floor: FloorSettings = MISSING
    light: LightSettings = MISSING

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_bodies()
        contact, drop, floor, light = self.contact, self.drop, self.floor, self.light
        require(0 <= contact.friction <= 10, "contact.friction", contact.friction, "0 to 10")
        allowed = f"a time constant of at least two timesteps ({2 * self.timestep} s) and a damping ratio above 0"
        is_stable = len(contact.solref) == 2 and contact.solref[0] >= 2 * self.timestep and contact.solref[1] > 0
        require(is_stable, "contact.solref", list(contact.solref), allowed)
        is_impedance = len(contact.solimp) == 3 and all(0 < value < 1 for value in contact.solimp)
        require(is_impedance, "contact.solimp", list(contact.solimp), "three numbers between 0 and 1")
        require(contact.solver in SOLVERS, "contact.solver", contact.solver, ", ".join(SOLVERS))
        require(0 < contact.tolerance <= 1e-2, "contact.tolerance", contact.tolerance, "above 0, at most 0.01")
        require(1 <= contact.iterations <= 1000, "contact.iterations", contact.iterations, "1 to 1,000")
        require(0 <= drop.offset <= 100, "drop.offset", drop.offset, "0 to 100 m")
        gaps = (drop.gap_min, drop.gap_max)
        allowed = f"2 bodies.skin ({2 * self.bodies.skin} m) < gap_min <= gap_max, so that nothing touches at the start"
        require(2 * self.bodies.skin < drop.gap_min <= drop.gap_max, "drop.gap_min, drop.gap_max", gaps, allowed)
        lowest = self.bodies.count * drop.gap_min
        require(drop.highest > lowest, "drop.highest", drop.highest, f"above the sum of the gaps ({lowest:g} m)")
        require(drop.max_speed > 0, "drop.max_speed", drop.max_speed, "above 0")
        require(1 <= drop.max_attempts <= 100, "drop.max_attempts", drop.max_attempts, "1 to 100")
        require(floor.half_size > 0 and floor.tile > 0, "floor", (floor.half_size, floor.tile), "sizes above 0")
        for name, color in (("color", floor.color), ("background", floor.background)):
            _require_color(f"floor.{name}", color)
        is_down = len(light.direction) == 3 and light.direction[2] < 0
        require(is_down, "light.direction", light.direction, "a downward direction")
        require(64 <= light.shadow_size <= 16384, "light.shadow_size", light.shadow_size, "64 to 16,384")

    def _check_bodies(self) -> None:
        bodies, known = self.bodies, list(shapes())
        require(1 <= bodies.count <= 8, "bodies.count", bodies.count, "1 to 8")
        require(len(bodies.shapes) > 0, "bodies.shapes", list(bodies.shapes), f"at least one of {', '.join(known)}")
        for name in bodies.shapes:
            if name not in known:
                raise ValueError(
                    f"bodies.shapes has {name!r}{did_you_mean(name, known).rstrip('.')}; allowed: {', '.join(known)}"
                )
            require(name in bodies.colors, "bodies.colors", list(bodies.colors), f"a colour for each shape ({name})")
            _require_color(f"bodies.colors.{name}", bodies.colors[name])
        require(0.3 <= bodies.spacing <= 0.6, "bodies.spacing", bodies.spacing, "0.3 to 0.6 m")
        require(0 < bodies.skin <= 0.1, "bodies.skin", bodies.skin, "above 0, at most 0.1 m")
        require(0 < bodies.density <= 1e4, "bodies.density", bodies.density, "above 0, at most 10,000 kg/m3")
        require(1e2 <= bodies.young <= 1e8, "bodies.young", bodies.young, "100 to 1e8 Pa")
        require(0 <= bodies.poisson < 0.5, "bodies.poisson", bodies.poisson, "0 to below 0.5")
        require(0 <= bodies.damping <= 10, "bodies.damping", bodies.damping, "0 to 10 s")


def _require_color(name: str, color: list[float]) -> None:
    is_color = len(color) == 3 and all(0 <= value <= 1 for value in color)
    require(is_color, name, list(color), "three numbers from 0 to 1")
