"""Settings of the pushing scene: no value stands here, all of them stand in ``conf/data_gen/pushing/``."""

import math
from dataclasses import dataclass

from omegaconf import MISSING

from data_gen.scene_settings import SceneSettings, require

SHAPES = ("box", "cylinder", "sphere", "capsule", "ellipsoid")


@dataclass
class TableSettings:
    """The table, whose top is at z = 0, and the floor beneath."""

    half_size: list[float] = MISSING  # m, of the top, along x and y
    thickness: float = MISSING  # m
    height: float = MISSING  # m, of the top above the floor
    friction: float = MISSING  # of table and floor; of two surfaces the larger one counts
    color: list[float] = MISSING  # sRGB in [0, 1]
    floor_color: list[float] = MISSING


@dataclass
class BodySettings:
    """What is pushed; uniform ranges."""

    count_min: int = MISSING
    count_max: int = MISSING
    shapes: list[str] = MISSING  # each as likely
    half_size: list[float] = MISSING  # m, least and largest, along each axis of a body
    mass: list[float] = MISSING  # kg
    friction: list[float] = MISSING  # sliding
    margin: float = MISSING  # m, least distance between bodies, and of bodies from the table's edge, at first


@dataclass
class PusherSettings:
    """A vertical cylinder on position-controlled axes x and y, and how it is moved.

    In a task it begins behind a body and pushes through its centre, then goes for another one; else it goes to random
    places over the table.
    """

    radius: float = MISSING  # m
    length: float = MISSING  # m
    clearance: float = MISSING  # m, above the table
    mass: float = MISSING  # kg
    friction: float = MISSING
    stiffness: float = MISSING  # N/m, of the position control
    damping: float = MISSING  # N s/m
    max_force: float = MISSING  # N
    task_share: float = MISSING  # of trajectories in which bodies are pushed on purpose
    speed: list[float] = MISSING  # m/s, least and largest, drawn for every motion
    start_distance: list[float] = MISSING  # m, from the body's surface to the pusher's, when a push begins
    push_length: list[float] = MISSING  # m
    overhang: float = MISSING  # m, how far beyond the table's edge it may go
    color: list[float] = MISSING
    num_points: int = MISSING  # on its surface, written into the file


@dataclass
class ArmSettings:
    """An arm that carries the pusher, above all bodies; ``links`` empty: the pusher moves by itself."""

    links: list[float] = MISSING  # m, upper arm and forearm
    base: list[float] = MISSING  # m, x and y of the column
    radius: float = MISSING  # m, of column and links
    mass: float = MISSING  # kg, of each link
    color: list[float] = MISSING
    num_points: int = MISSING  # on the surface of each link, written into the file


@dataclass
class LightSettings:
    """One directional light with a cast shadow, and ambient light."""

    direction: list[float] = MISSING  # where the light travels
    ambient: float = MISSING
    diffuse: float = MISSING


@dataclass
class PushingSettings(SceneSettings):
    """Everything that decides what is in the data set (with the seed)."""

    camera_delay: float = MISSING  # s, by which pictures (and the ground truth that belongs to them) lag the action
    table: TableSettings = MISSING
    bodies: BodySettings = MISSING
    pusher: PusherSettings = MISSING
    arm: ArmSettings = MISSING
    light: LightSettings = MISSING

    def __post_init__(self) -> None:
        super().__post_init__()
        table, bodies, pusher = self.table, self.bodies, self.pusher
        allowed = "0 to less than frame_time, a multiple of timestep"
        steps = self.camera_delay / self.timestep
        is_allowed = 0 <= self.camera_delay < self.frame_time and abs(steps - round(steps)) < 1e-6
        require(is_allowed, "camera_delay", self.camera_delay, allowed)
        require(
            len(table.half_size) == 2 and min(table.half_size) > 0, "table.half_size", table.half_size, "two lengths"
        )
        require(0 < table.thickness < table.height, "table.thickness", table.thickness, "above 0, below table.height")
        counts = (bodies.count_min, bodies.count_max)
        require(1 <= counts[0] <= counts[1] <= 20, "bodies.count_min, count_max", counts, "1 to 20, min <= max")
        unknown = [name for name in bodies.shapes if name not in SHAPES]
        require(
            bool(bodies.shapes) and not unknown, "bodies.shapes", list(bodies.shapes), f"some of {', '.join(SHAPES)}"
        )
        ranges = {f"bodies.{name}": getattr(bodies, name) for name in ("half_size", "mass", "friction")}
        ranges |= {f"pusher.{name}": getattr(pusher, name) for name in ("speed", "start_distance", "push_length")}
        for name, ends in ranges.items():
            require(len(ends) == 2 and 0 < ends[0] <= ends[1], name, list(ends), "least and largest, above 0")
        for name in ("radius", "length", "clearance", "mass", "stiffness", "damping", "max_force"):
            require(getattr(pusher, name) > 0, f"pusher.{name}", getattr(pusher, name), "above 0")
        self._check_arm()
        require(0 <= pusher.task_share <= 1, "pusher.task_share", pusher.task_share, "0 to 1")
        require(8 <= pusher.num_points <= 10_000, "pusher.num_points", pusher.num_points, "8 to 10,000")
        require(self.light.direction[2] < 0, "light.direction", self.light.direction, "a downward direction")

    def _check_arm(self) -> None:
        arm = self.arm
        if not arm.links:
            return
        require(
            len(arm.links) == 2 and min(arm.links) > 0, "arm.links", list(arm.links), "none, or two lengths above 0"
        )
        require(len(arm.base) == 2, "arm.base", list(arm.base), "x and y")
        for name in ("radius", "mass"):
            require(getattr(arm, name) > 0, f"arm.{name}", getattr(arm, name), "above 0")
        require(8 <= arm.num_points <= 10_000, "arm.num_points", arm.num_points, "8 to 10,000")
        limit = [half + self.pusher.overhang for half in self.table.half_size]
        away = [max(0.0, abs(x) - end) for x, end in zip(arm.base, limit, strict=True)]
        far = [abs(x) + end for x, end in zip(arm.base, limit, strict=True)]
        reach = f"{abs(arm.links[0] - arm.links[1]):.3g} to {sum(arm.links):.3g} m from arm.base, as the pusher may be"
        fits = math.hypot(*away) > abs(arm.links[0] - arm.links[1]) and math.hypot(*far) < sum(arm.links)
        require(fits, "arm.links", list(arm.links), f"a reach ({reach}) that covers {limit} m about the origin")

    @property
    def pusher_lag(self) -> float:
        """Frames by which the pusher follows a moving place that it is told, one at most: damping over stiffness."""
        return min(1.0, self.pusher.damping / self.pusher.stiffness / self.frame_time)

    @property
    def arm_height(self) -> float:
        """Height of the arm's links above the table, metres: the pusher hangs from them."""
        return self.pusher_height + self.pusher.length / 2 + self.arm.radius

    @property
    def delay_steps(self) -> int:
        """Physics steps from a picture to the action that its frame goes with."""
        return round(self.camera_delay / self.timestep)

    @property
    def pusher_height(self) -> float:
        """Height of the pusher's middle above the table, metres."""
        return self.pusher.clearance + self.pusher.length / 2
