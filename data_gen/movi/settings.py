"""Settings of the MOVi-like scenes: no value stands here, all of them stand in ``conf/data_gen/movi_*/``."""

import math
from dataclasses import dataclass
from typing import ClassVar

from omegaconf import MISSING

from data_gen.movi.contacts import CALIBRATED_TIMESTEP, LARGEST_RESTITUTION, Surface
from data_gen.movi.shapes import SHAPES
from data_gen.scene_settings import SceneSettings, require

SIZE_CHOICES = ("one_of", "between")
OBJECT_COLORS = ("clevr", "hue", "texture")
SURROUNDINGS = ("grey", "hue", "texture")
# m, half the side of the floor that takes light and shadow (whole tiles of its texture). Beyond it the ground shows its
# own colour as the dome does, for towards the border of the sun's shadow map a lit floor has speckles.
LIT_HALF_SIZE = 20.0


@dataclass
class MaterialSettings:
    """What an object is made of."""

    name: str = MISSING
    friction: float = MISSING  # sliding; the floor's multiplies it
    restitution: float = MISSING  # the floor's multiplies it
    density: float = MISSING  # kg/m^3
    specular: float = MISSING  # 0 to 1, strength of highlights
    shininess: float = MISSING  # 0 to 1, sharpness of highlights


@dataclass
class ObjectSettings:
    """What is thrown."""

    count: int = MISSING
    shapes: list[str] = MISSING  # of data_gen.movi.shapes; none: textured stand-ins for scans, or the user's meshes
    mesh_folder: str | None = MISSING  # folder of .obj and .glb files to throw; needs shapes=[]
    mesh_hash: str = MISSING  # of that folder's contents; filled in here, for files made from other meshes are others
    size_choice: str = MISSING  # one_of | between
    sizes: list[float] = MISSING  # m, longest side: the sizes to choose from, or the smallest and the largest
    color: str = MISSING  # clevr (eight colours) | hue (random) | texture (the mesh's own)
    materials: list[MaterialSettings] = MISSING  # each as likely


@dataclass
class FloorSettings:
    """The floor, a square at z = 0, and the dome over it, which nothing collides with."""

    friction: float = MISSING
    restitution: float = MISSING
    look: str = MISSING  # of floor and dome: grey | hue (random, the same for both) | texture (random)
    dome_radius: float = MISSING  # m


@dataclass
class LightSettings:
    """Light without direction, a sun that casts shadows, and two weak lights from other sides that do not."""

    direction: list[float] = MISSING  # where the sun's light travels
    ambient: float = MISSING
    sun: float = MISSING
    fill: float = MISSING


@dataclass
class ThrowSettings:
    """Initial state: uniform orientation, no rotation, velocity = uniform - position, horizontal parts."""

    region_min: list[float] = MISSING  # m; an object's bounding box lies within the region
    region_max: list[float] = MISSING
    velocity_max: list[float] = MISSING  # m/s, symmetric about 0
    max_trials: int = MISSING  # positions to try for an object before all are placed anew


@dataclass
class MoviSettings(SceneSettings):
    """Everything that decides what is in the data set (with the seed)."""

    PLACES: ClassVar[tuple[tuple[str, str], ...]] = (("objects", "mesh_folder"),)  # its content is in mesh_hash

    objects: ObjectSettings = MISSING
    floor: FloorSettings = MISSING
    light: LightSettings = MISSING
    throw: ThrowSettings = MISSING

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = f"above 0, at most 1/{round(1 / CALIBRATED_TIMESTEP)} s, for which contacts are calibrated"
        require(self.timestep <= CALIBRATED_TIMESTEP * (1 + 1e-9), "timestep", self.timestep, allowed)
        self._check_objects()
        self._check_materials()
        floor, light, throw = self.floor, self.light, self.throw
        require(floor.look in SURROUNDINGS, "floor.look", floor.look, ", ".join(SURROUNDINGS))
        reach = self.camera.radius + max(map(abs, self.camera.target))
        least = max(reach, LIT_HALF_SIZE * math.sqrt(2))
        allowed = f"above {least:g} m (the cameras and the floor)"
        require(floor.dome_radius > least, "floor.dome_radius", floor.dome_radius, allowed)
        require(light.direction[2] < 0, "light.direction", light.direction, "a downward direction")
        for name in ("region_min", "region_max", "velocity_max"):
            require(len(getattr(throw, name)) == 3, f"throw.{name}", getattr(throw, name), "three numbers")
        ordered = all(low < high for low, high in zip(throw.region_min, throw.region_max, strict=True))
        regions = (list(throw.region_min), list(throw.region_max))
        require(ordered, "throw.region_min, throw.region_max", regions, "min below max on every axis")
        require(throw.region_min[2] >= 0, "throw.region_min", throw.region_min, "a region above the floor")
        require(1 <= throw.max_trials <= 100_000, "throw.max_trials", throw.max_trials, "1 to 100,000")

    def _check_objects(self) -> None:
        objects = self.objects
        require(1 <= objects.count <= 50, "objects.count", objects.count, "1 to 50")
        unknown = [name for name in objects.shapes if name not in SHAPES]
        require(not unknown, "objects.shapes", unknown, f"[] or names out of {', '.join(SHAPES)}")
        require(objects.size_choice in SIZE_CHOICES, "objects.size_choice", objects.size_choice, "one_of, between")
        sizes = objects.sizes
        good = len(sizes) >= 1 and all(0.05 <= size <= 4 for size in sizes)
        if objects.size_choice == "between":
            good = good and len(sizes) == 2 and sizes[0] <= sizes[1]
        require(
            good, "objects.sizes", sizes, "sizes of 0.05 to 4 m; with size_choice=between the least and the largest"
        )
        require(objects.color in OBJECT_COLORS, "objects.color", objects.color, ", ".join(OBJECT_COLORS))
        textured = objects.color == "texture"
        require(
            textured != bool(objects.shapes),
            "objects.color",
            objects.color,
            "texture where shapes is [], and only there",
        )
        if objects.mesh_folder is None:
            require(objects.mesh_hash == "", "objects.mesh_hash", objects.mesh_hash, "'' without objects.mesh_folder")
        else:
            require(
                not objects.shapes, "objects.mesh_folder", objects.mesh_folder, "null where objects.shapes names shapes"
            )
            self._take_mesh_hash(objects.mesh_folder)

    def _take_mesh_hash(self, folder: str) -> None:
        from data_gen.movi.user_meshes import load_folder

        found = load_folder(folder).sha256()
        given = self.objects.mesh_hash
        require(given in ("", found), "objects.mesh_hash", given, f"{found}, the hash of {folder} as it is now")
        self.objects.mesh_hash = found

    def _check_materials(self) -> None:
        materials, floor = self.objects.materials, Surface(self.floor.friction, self.floor.restitution)
        require(len(materials) >= 1, "objects.materials", [], "at least one material")
        surfaces = {"floor": floor}
        for material in materials:
            name = f"objects.materials {material.name}"
            require(material.density > 0, f"{name} density", material.density, "above 0")
            surfaces[name] = Surface(material.friction, material.restitution)
        for name, surface in surfaces.items():
            require(0 < surface.friction <= 10, f"{name} friction", surface.friction, "above 0, at most 10")
            require(0 <= surface.restitution <= 1, f"{name} restitution", surface.restitution, "0 to 1")
        liveliest = max(surface.restitution for name, surface in surfaces.items() if name != "floor")
        product = liveliest * max(floor.restitution, liveliest)
        allowed = f"products of at most {LARGEST_RESTITUTION}"
        require(product <= LARGEST_RESTITUTION, "restitution of two bodies", product, allowed)
