"""The project file: what a surveyor writes down, read strictly."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from dougong.errors import InputError
from dougong.formats import SUFFIXES, scans_in
from dougong.formats.registry import kind_of
from dougong.formats.stream import stem_of
from dougong.formats.units import KNOWN_SYSTEMS, as_wkt
from dougong.params import Parameters
from dougong.pipeline.merging import Merge
from dougong.pipeline.recipes import Recipe
from dougong.pipeline.settings import suggestion, validated
from dougong.registration import Register
from dougong.typing import Kind

_RESULT = ("merged.copc.laz", "clouds", "removed", "distances", "full")
"""What holds clouds in the folder of a result."""


class Head(Parameters):
    """What the project is called, and whose frame its result has."""

    name: str = "dougong project"
    """Title of the report."""
    reference: str | None = None
    """Cloud in whose frame the result is; default: the first photogrammetry cloud, else lidar, in
    known units."""
    full_resolution: bool = False
    """Also write every input file, undecimated, in the frame of the reference."""


class Entry(Parameters):
    """One cloud, in as many tables as there are clouds."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[^/\\\x00]+$")]
    """What the cloud and its files in the result are called; each differs from the others."""
    kind: Kind
    """The sensor, which decides the filters."""
    files: Annotated[tuple[str, ...], Field(min_length=1)]
    """Paths or patterns, relative to the project file."""
    crs: str | None = None
    """Coordinate system of files that name none: "EPSG:32650", compound "EPSG:32650+5773", WKT; or
    the unit of local coordinates, such as "mm"."""
    registered: bool = True
    """False: each station (E57) or file moves by itself."""
    scale_known: bool = True
    """False: the cloud's unit is not known to be the metre; then its scale is searched too."""

    @field_validator("crs")
    @classmethod
    def _is_a_system(cls, crs: str | None) -> str | None:
        if crs is not None and as_wkt(crs) is None:
            msg = f"{crs!r} is no coordinate system; expected {KNOWN_SYSTEMS}"
            raise ValueError(msg)
        return crs


class Quality(Parameters):
    """What the result is measured against."""

    control: str | None = None
    """CSV of control and check points, relative to the project file."""
    required_level: Literal["LOA10", "LOA20", "LOA30", "LOA40", "LOA50"] | None = None
    """USIBD level of accuracy the result must reach."""


class Project(Parameters):
    """A whole project."""

    model_config = ConfigDict(populate_by_name=True)

    project: Head = Head()
    cloud: Annotated[tuple[Entry, ...], Field(min_length=1)]
    filter: Recipe = Recipe()
    registration: Annotated[Register, Field(alias="register")] = Register()
    merge: Merge = Merge()
    quality: Quality = Quality()

    @field_validator("cloud")
    @classmethod
    def _names_differ(cls, clouds: tuple[Entry, ...]) -> tuple[Entry, ...]:
        names = [entry.name for entry in clouds]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            msg = f"two clouds are called {twice[0]!r}; every cloud needs a name of its own"
            raise ValueError(msg)
        return clouds

    @model_validator(mode="after")
    def _scales_can_be_found(self) -> "Project":
        unscaled = [entry for entry in self.cloud if not entry.scale_known]
        for entry in unscaled:
            if not entry.registered:
                msg = (
                    f"cloud {entry.name!r} has scale_known = false and registered = false: one "
                    "scale is searched per cloud. List files of different blocks as clouds of "
                    "their own"
                )
                raise ValueError(msg)
            if entry.crs is not None:
                msg = (
                    f"cloud {entry.name!r} has scale_known = false and a crs, which would give its "
                    "unit. Take one of them out"
                )
                raise ValueError(msg)
        if self.registration.dof in (5, 7) and not unscaled:
            msg = (
                f"register.dof is {self.registration.dof}, but every cloud's scale is known: write "
                "scale_known = false in the cloud whose scale is to be searched"
            )
            raise ValueError(msg)
        if len(unscaled) == len(self.cloud):
            msg = (
                "every cloud has scale_known = false; one in known units is expected, to measure "
                "the others by. Laser scans are in metres"
            )
            raise ValueError(msg)
        wanted = self.project.reference
        if wanted in [entry.name for entry in unscaled]:
            msg = (
                f"project.reference names {wanted!r}, which has scale_known = false: a result in "
                "its frame would have no unit. Name a cloud in known units, or leave it out"
            )
            raise ValueError(msg)
        return self

    @model_validator(mode="after")
    def _reference_exists(self) -> "Project":
        names = [entry.name for entry in self.cloud]
        wanted = self.project.reference
        if wanted is not None and wanted not in names:
            msg = (
                f"project.reference names {wanted!r}, which is no cloud"
                f"{suggestion(wanted, names)} Clouds: {', '.join(names)}"
            )
            raise ValueError(msg)
        return self

    def reference(self) -> str:
        """Return the name of the cloud in whose frame the result is."""
        if self.project.reference is not None:
            return self.project.reference
        known = [entry for entry in self.cloud if entry.scale_known]
        drones = [entry.name for entry in known if entry.kind == "photogrammetry"]
        return drones[0] if drones else known[0].name


def read_project(path: Path) -> Project:
    """Read a project file.

    Raises
    ------
    InputError
        It is missing, a cloud, no TOML, has an unknown or wrong key, or asks for what this
        version cannot do.
    """
    if path.suffix.lower() in SUFFIXES and path.is_file():
        msg = (
            f"{path} is a point cloud by its name, expected a project file. Pass it as "
            f"--lidar {path.name} or --photogrammetry {path.name}."
        )
        raise InputError(msg)
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        msg = f"there is no project file {path}. `dougong init DIR` writes one."
        raise InputError(msg) from None
    except IsADirectoryError:
        msg = f"{path} is a folder. Name the project file in it."
        raise InputError(msg) from None
    except UnicodeDecodeError as error:
        msg = f"{path} is no text file (byte {error.start}). Save the project file as UTF-8."
        raise InputError(msg) from None
    except tomllib.TOMLDecodeError as error:
        msg = f"{path} is no valid TOML: {error}. Compare it with the output of `dougong init`."
        raise InputError(msg) from None
    project = validated(Project, values, str(path))
    return project


def asked_project(
    project: Path | None,
    lidar: Sequence[Path],
    photogrammetry: Sequence[Path],
    full_resolution: bool,
    merge: str | None = None,
) -> tuple[Project, Path]:
    """Return the project of a command line, and the folder that its paths are relative to.

    Raises
    ------
    InputError
        A project file and clouds are given, or the project is wrong.
    """
    if project is not None and (lidar or photogrammetry):
        msg = "a project file and --lidar or --photogrammetry were given. Pass one or the other."
        raise InputError(msg)
    asked = from_files(lidar, photogrammetry) if project is None else read_project(project)
    if merge is not None:
        asked = asked.model_copy(update={"merge": asked.merge.model_copy(update={"mode": merge})})
    if full_resolution:
        head = asked.project.model_copy(update={"full_resolution": True})
        asked = asked.model_copy(update={"project": head})
    return asked, Path() if project is None else project.parent


def files_of(entry: Entry, folder: Path) -> list[Path]:
    """Return the files of a cloud, patterns expanded, each once, sorted within a pattern.

    Raises
    ------
    InputError
        A path or pattern finds no file, or is none.
    """
    found: list[Path] = []
    for text in entry.files:
        path = Path(text)
        base, pattern = (
            (Path(path.anchor), str(path.relative_to(path.anchor)))
            if (path.is_absolute())
            else (folder, text)
        )
        exact = base / pattern
        try:
            matches = [exact] if exact.is_file() else sorted(base.glob(pattern))
        except ValueError as error:
            msg = f"cloud {entry.name!r}: {text!r} is no path and no pattern ({error})."
            raise InputError(msg) from error
        matches = [match for match in matches if match.is_file()]
        if not matches:
            raise InputError(f"cloud {entry.name!r}: {_why_no_file(text, exact, folder)}")
        found += [match for match in matches if match not in found]
    return found


def _why_no_file(text: str, exact: Path, folder: Path) -> str:
    """Return why a path or pattern of a project finds no file, and what to do."""
    if exact.is_dir():
        return f"{text} is a folder. Name the files in it, or a pattern such as {text}/*.laz."
    if Path(text).is_absolute():
        return f"there is no file {text}."
    return (
        f"no file matches {text!r} in {folder.resolve()}. Paths are relative to the project file."
    )


def all_files(project: Project, folder: Path) -> list[Path]:
    """Return the files of all clouds of a project.

    Raises
    ------
    InputError
        A path or pattern finds no file, or one file is there twice: its points would be too, and
        would register onto themselves without an error; or a cloud is called as a station is.
    FormatError
        One of them is no point cloud.
    """
    known: dict[Path, Path] = {}
    for file in (file for entry in project.cloud for file in files_of(entry, folder)):
        _refuse_twice(file, known)
        kind_of(file)
    for entry in project.cloud:
        _refuse_station_names(entry, project, folder)
    return list(known.values())


def _refuse_station_names(entry: Entry, project: Project, folder: Path) -> None:
    """Raise InputError where another cloud is called as a station of `entry` will be."""
    names = [other.name for other in project.cloud if other.name.startswith(f"{entry.name}-")]
    ends = {name: name.removeprefix(f"{entry.name}-") for name in names}
    alike = {name: int(end) for name, end in ends.items() if end.isdecimal()}
    if entry.registered or not alike:
        return
    count = sum(scans_in(file)[0] for file in files_of(entry, folder))
    for name, number in alike.items():
        if count > 1 and 1 <= number <= count:
            msg = (
                f"cloud {name!r} is called as station {number} of cloud {entry.name!r}, whose "
                f"{count} stations move by themselves. Rename one of both clouds."
            )
            raise InputError(msg)


def _refuse_twice(file: Path, known: dict[Path, Path]) -> None:
    """Add `file` to the files known by where they lie; raise InputError where it is one of them."""
    before = known.setdefault(file.resolve(), file)
    if before is not file:
        names = f"{file} is" if before == file else f"{before} and {file} are"
        raise InputError(f"{names} one file, named twice. Name each file once.")


def refuse_own_result(files: Sequence[Path], out: Path) -> None:
    """Refuse inputs that an earlier run into the same folder wrote.

    Raises
    ------
    InputError
        A pattern found the result: its points would be in the next one twice, and again.
    """
    folder = out.resolve()
    for file in files:
        place = file.resolve()
        inside = place.relative_to(folder).parts if place.is_relative_to(folder) else ()
        if inside and inside[0] in _RESULT:
            msg = (
                f"{file} is part of the result in {out}, expected a cloud of the survey. Choose "
                "another --out, or a pattern that leaves the result out."
            )
            raise InputError(msg)


def from_files(lidar: Sequence[Path], photogrammetry: Sequence[Path]) -> Project:
    """Return the project of ``dougong run --lidar A --photogrammetry B``.

    Raises
    ------
    InputError
        No cloud is named, one is named twice, or two have the same file stem.
    """
    kinds: list[tuple[Kind, Path]] = [("lidar", path) for path in lidar]
    kinds += [("photogrammetry", path) for path in photogrammetry]
    if not kinds:
        msg = "no cloud is named. Pass a project file, or --lidar FILE and --photogrammetry FILE."
        raise InputError(msg)
    names: dict[str, Path] = {}
    known: dict[Path, Path] = {}
    for _, path in kinds:
        if not is_text(path):
            raise InputError(f"the name of {path} is no UTF-8 text. Rename it.")
        _refuse_twice(path, known)
        before = names.setdefault(stem_of(path), path)
        if before is path:
            continue
        msg = (
            f"{before} and {path} would both be the cloud {stem_of(path)!r}: a cloud is called as "
            "its file is. Rename one, or write a project file (`dougong init DIR`)."
        )
        raise InputError(msg)
    # Not behind links: what they lead to may have no suffix (as in a cache of data versions).
    clouds = [
        {"name": stem_of(path), "kind": kind, "files": [str(path.parent.resolve() / path.name)]}
        for kind, path in kinds
    ]
    return validated(Project, {"cloud": clouds}, "the clouds named on the command line")


def is_text(path: Path) -> bool:
    """Say whether a path is UTF-8, which a project file and every result is."""
    # Python keeps bytes that it cannot decode as these.
    return not any("\udc80" <= letter <= "\udcff" for letter in str(path))
