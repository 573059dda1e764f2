"""Structure files and site files (TOML): read into validated settings, with every problem reported at once."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from drivers.base import UNIT_OF, Source, SourceContext, SourceError
from drivers.live import LiveBounds, LiveSettings
from drivers.registry import UnknownSourceError, source_type
from drivers.settings import RecorderSettings
from monitor.config.matrix_files import read_matrices
from monitor.config.service_settings import LogSettings, StateSettings
from monitor.core import (
    DIRECTION_WORDS,
    BadConfigurationError,
    MissingInputError,
    Settings,
    parse_address,
    read_settings,
    settings_problems,
)
from monitor.damage import LEVEL, UNMEASURED, AlarmSettings, CovariateSettings, UpdatingSettings
from monitor.diagnosis import DiagnosisSettings, WatchSettings
from monitor.events import EventSettings
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, TrackSettings
from monitor.model import (
    FORMS,
    Building,
    BuildingTable,
    Drawing,
    DrawnTable,
    Effect,
    EffectError,
    InstrumentedModel,
    LineTable,
    ModalTable,
    Model,
    NodeTable,
    ShearFrame,
    StoreyTable,
    StructureTable,
    drawing_problems,
    place_index,
)
from monitor.signals import FrontEnd, HealthSettings, ProcessingSettings, QualitySettings, TemperatureSettings

NO_MODEL = (
    'structure.kind: "modal" has no model of masses and stiffnesses, and this needs one: state kind = "building", '
    '"shear_frame" or "matrices" with the floor of each sensor'
)
"""What is said where a model is needed and none is drawn. [words]"""


class SensorTable(Settings):
    """``[[sensors]]``: one channel of an accelerometer or a gyroscope."""

    channel: str = Field(min_length=1)
    """Name of the channel in the data."""
    floor: int | None = Field(default=None, ge=0)
    """Floor (degree of freedom) on which the sensor is mounted; 1 is the top floor, of a building that above the first storey.
    Needed unless the structure is ``modal``.  0 is the ground, for a witness."""
    label: str = ""
    """Where the sensor is, for people, as ``mid-span, north``."""
    quantity: Literal["acceleration", "rotation_rate"] = "acceleration"
    """What is measured: an acceleration, on the topic ``/acceleration``, or a rate of rotation, on ``/rotation_rate``."""
    axis: Literal["x", "y", "z"] | None = None
    """Axis along which, or about which, it is measured: ``x`` is the direction in which the floors move in the model, ``z`` is
    up.  ``x`` by default for an acceleration; needed for a rate of rotation.  What is no acceleration along ``x``, or ``y`` in
    a building, is a witness: it enters no estimate, and a diagnosis says whether it agrees."""
    position_m: tuple[float, float] = (0.0, 0.0)
    """Place on the floor of a building, along x and y from the middle of its plan."""
    mounted: Literal["joint", "midspan"] = "joint"
    """Where on the floor a gyroscope is: at a joint of column and girder, or in the middle of a girder."""

    @property
    def along(self) -> str | None:
        """Axis of an acceleration; None for another quantity."""
        return (self.axis or "x") if self.quantity == "acceleration" else None


class InputTable(Settings):
    """``[[inputs]]``: one measured force on the structure, as of a shaker or a hammer."""

    channel: str = Field(min_length=1)
    """Name of the channel on the topic ``/force``, N."""
    floor: int = Field(ge=1)
    """Floor (degree of freedom) on which the force acts; 1 is the top floor, of a building that above the first storey."""
    axis: Literal["x", "y"] = "x"
    """Axis along which the force acts on a building's floor, at its centre of stiffness."""

    @model_validator(mode="before")
    @classmethod
    def _node_is_floor(cls, table: Any) -> Any:
        """Take ``node`` for ``floor``: a structure given by its matrices has nodes."""
        if isinstance(table, dict) and "node" in table and "floor" not in table:
            return {**{k: v for k, v in table.items() if k != "node"}, "floor": table["node"]}
        return table


class CovariateTable(Settings):
    """``[[covariates]]``: one measured quantity that the healthy stiffness may depend on."""

    name: str = Field(min_length=1)
    """Name in the results.  ``temperature`` and ``level`` are covariates without being named."""
    topic: str = Field(pattern="^/.+")
    """Topic of the samples, as ``/wind``."""
    channel: str | None = None
    """Channel of the topic; by default the mean of all its channels."""
    unit: str
    """Unit of the samples, as ``m/s``."""


class EffectTable(Settings):
    """``[[effects]]``: one effect that extends the structure."""

    effect: str
    """Name of the effect, as in docs/effects.md."""
    location: str
    """``story 2``, ``floor 1``, ``channel a2``, ``base`` or ``frame``."""
    parameters: dict[str, float] = Field(default_factory=dict)


class SiteSettings(Settings):
    """``[site]`` of the daemon's file."""

    name: str = ""
    """Name of the site in keys, metrics, messages and the log; by default the name of the structure."""
    formerly: str = ""
    """Name under which the site wrote into its output folder before; the folder of another site is refused."""
    contact: str = ""
    """Whom to call, and how, as the page and the reports say it: ``"Ada Bell, +44 20 7946 0000"``."""
    baseline: str | None = None
    """Baseline file that 'calibrate' wrote. All paths of a site file are relative to it. Without a baseline there is no alarm."""


_BUCKET_URL = re.compile(r"s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[^/\s]+)*/?")


class OutputSettings(Settings):
    """``[output]`` of the daemon's file."""

    dir: str = "out"
    """Folder of everything that the daemon writes."""
    keep_gb: float | None = Field(default=None, gt=0)
    """Greatest disk space of the whole folder, in GiB: beyond it the oldest recordings go, then the oldest closed months of
    results.  By default the recordings alone are bounded, by `[recorder] keep_gb`."""
    store: str | None = None
    """Address in object storage, as ``s3://BUCKET/NAME``, where the files of the folder are kept as well, so that a monitor on
    another machine can go on with them (`monitor.service.site_store`)."""
    store_every_s: float = Field(default=5.0, ge=1.0, le=3600.0)
    """Interval at which what has changed is stored, in s; after three of them without a word another machine may take over."""
    pack_months: bool = False
    """Pack the results of each closed month into ``results-YYYY-MM.jsonl.zst``."""
    serve: str | None = None
    """HOST:PORT of the server that Rerun viewers may join."""
    web: str | None = None
    """HOST:PORT of the web page with the results; port 0 for any free one.  Another host than loopback needs `web_token_file`."""
    web_token_file: str | None = None
    """File with the token that readers of the web page must show, mode 0600."""
    zenoh: dict[str, Any] | None = None
    """Table of the publisher of results, alarms and health over Zenoh (`monitor.service.outlets`)."""
    mqtt: dict[str, Any] | None = None
    """Table of the publisher of results, alarms and health over MQTT (`monitor.service.outlets`)."""
    metrics: dict[str, Any] | None = None
    """Table of the endpoint for Prometheus (`monitor.service.outlets`)."""

    @field_validator("store")
    @classmethod
    def _stores(cls, url: str | None) -> str | None:
        if url is not None and not _BUCKET_URL.fullmatch(url):
            raise ValueError(f"{url!r} is no address as s3://BUCKET/NAME")
        return url

    @field_validator("serve", "web")
    @classmethod
    def _is_address(cls, text: str | None, info: ValidationInfo) -> str | None:
        if text is not None:
            parse_address(text, any_port=info.field_name == "web")
        return text

    @property
    def web_address(self) -> tuple[str, int] | None:
        """Host and port of `web`; None if no page is wanted."""
        return None if self.web is None else parse_address(self.web, any_port=True)

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port of `serve`; None if no server is wanted."""
        return None if self.serve is None else parse_address(self.serve)


class Configuration(Settings):
    """Settings of a structure file or a site file.

    Examples
    --------
    >>> structure = {"kind": "shear_frame", "masses_kg": [1000.0, 1000.0], "stiffness_n_per_m": [2e6, 2e6]}
    >>> sensors = [{"channel": "a1", "floor": 1}, {"channel": "a2", "floor": 2}]
    >>> config = Configuration.model_validate({"structure": structure, "sensors": sensors})
    >>> config.model().modes().frequencies_hz.round(3)
    array([ 4.399, 11.517])
    """

    structure: StructureTable
    storeys: tuple[StoreyTable, ...] = ()
    sensors: tuple[SensorTable, ...] = Field(min_length=1)
    inputs: tuple[InputTable, ...] = ()
    covariates: tuple[CovariateTable, ...] = ()
    effects: tuple[EffectTable, ...] = ()
    nodes: tuple[NodeTable, ...] = ()
    lines: tuple[LineTable, ...] = ()
    processing: ProcessingSettings = ProcessingSettings()
    quality: QualitySettings = QualitySettings()
    health: HealthSettings = HealthSettings()
    identification: SsiSettings = SsiSettings()
    selection: SelectionSettings = SelectionSettings()
    refinement: RefinementSettings = RefinementSettings()
    tracking: TrackSettings = TrackSettings()
    updating: UpdatingSettings = UpdatingSettings()
    temperature: TemperatureSettings = TemperatureSettings()
    compensation: CovariateSettings = CovariateSettings()
    alarm: AlarmSettings = AlarmSettings()
    diagnosis: DiagnosisSettings = DiagnosisSettings()
    watch: WatchSettings = WatchSettings()
    events: EventSettings = EventSettings()
    topics: dict[str, str] = Field(default_factory=dict)
    """Topic map for foreign recordings: ROS 2 Imu topic to channel, as ``"/imu/top" = "a1.x"``."""
    site: SiteSettings = SiteSettings()
    source: dict[str, Any] | None = None
    output: OutputSettings = OutputSettings()
    recorder: RecorderSettings = RecorderSettings()
    state: StateSettings = StateSettings()
    log: LogSettings = LogSettings()
    notify: dict[str, Any] = Field(default_factory=dict)
    """Table of the notifications to people (`monitor.service.outlets`)."""

    @model_validator(mode="after")
    def _consistent(self) -> Configuration:
        if self.storeys and "max_modes" not in self.selection.model_fields_set:  # four in each direction
            more = self.selection.model_copy(update={"max_modes": len(DIRECTION_WORDS) * self.selection.required_modes})
            object.__setattr__(self, "selection", more)
        if self.storeys and not isinstance(self.structure, BuildingTable):
            raise ValueError('storeys: they belong to [structure] kind = "building"')
        if not self.floor_sensors:
            which = " or y" if isinstance(self.structure, BuildingTable) else ""
            raise ValueError(
                f"sensors: none of them is an accelerometer along x{which}, by which the structure is judged"
            )
        turning = [i for i, s in enumerate(self.sensors) if s.quantity == "rotation_rate" and s.axis is None]
        problems = [f"sensors.{i}.axis: Field required: about which axis is the rotation?" for i in turning]
        problems += [f"sensors: channel {problem}" for problem in _twice(s.channel for s in self.sensors)]
        problems += self._modal_problems() if isinstance(self.structure, ModalTable) else self._drawn_problems()
        problems += self._covariate_problems()
        references = self.identification.reference_channels
        problems += [f"identification: no channel {c!r}" for c in references if c not in self.channels]
        p, lags, step_s = self.processing, self.front_end().n_lags, self.front_end().step_s
        if step_s * p.rate_hz < lags:
            problems.append(
                f"processing: window_s and hop_s have a common step of {step_s:g} s, "
                f"but {lags / p.rate_hz:g} s (2 block_rows samples) is the least: set a longer hop_s that divides window_s"
            )
        elif abs(step_s * p.rate_hz - round(step_s * p.rate_hz)) > 1e-6:
            problems.append(f"processing: window_s and hop_s must be whole numbers of samples at {p.rate_hz:g} Hz")
        if not problems and self.has_model:
            problems += self._model_problems()
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def _drawn_problems(self) -> list[str]:
        """Check that the tables fit the floors and stories of the drawing."""
        n, stories = len(self.drawn.masses_kg), len(self.drawn.stiffness_n_per_m)
        problems = [f"sensors.{i}.floor: Field required" for i, s in enumerate(self.sensors) if s.floor is None]
        problems += [
            f"sensors.{i}.floor: {s.channel!r} is on floor {s.floor} of {n}"
            for i, s in enumerate(self.sensors)
            if s.floor is not None and not int(s not in self.witnesses) <= s.floor <= n
        ]
        problems += [f"inputs: channel {problem}" for problem in _twice(i.channel for i in self.inputs)]
        problems += [f"inputs: {i.channel!r} acts on floor {i.floor} of {n}" for i in self.inputs if i.floor > n]
        for table in self.effects:
            try:
                self._effect(table)
            except EffectError as error:
                problems.append(f"effects: {error}")
        problems += [f"alarm.unwatched: there is no story {j}" for j in self.alarm.unwatched if not 1 <= j <= stories]
        return problems + drawing_problems(self.nodes, self.lines, self.drawn.structure().n_dofs, stories)

    def _modal_problems(self) -> list[str]:
        """Check that nothing is stated that needs a model."""
        on_floors = [i for i, s in enumerate(self.sensors) if s.floor is not None]
        problems = [f"sensors.{i}.floor: there are no floors" for i in on_floors]
        problems += [f"inputs: {i.channel!r}: a force needs a model to act on" for i in self.inputs]
        problems += [f"effects: {t.effect!r}: there is no model that it could extend" for t in self.effects]
        problems += [f"alarm.unwatched: there is no story {j}" for j in self.alarm.unwatched]
        problems += [f"events.limits: {x.says!r}: there are no stories to judge" for x in self.events.limits]
        problems = [f'{problem} with [structure] kind = "modal"' for problem in problems]
        return problems + drawing_problems(self.nodes, self.lines, len(self.floor_sensors), 0)

    def _covariate_problems(self) -> list[str]:
        """Check the names and topics of the covariates."""
        named = [t.name for t in self.covariates]
        problems = _twice(named)
        problems += [f"{n!r} is one without being named" for n in named if n in (LEVEL, "temperature", UNMEASURED)]
        taken = [t for t in self.covariates if t.topic in UNIT_OF]
        problems += [f"{t.name!r}: the topic {t.topic} carries {UNIT_OF[t.topic]}" for t in taken]
        return [f"covariates: {problem}" for problem in problems]

    def _model_problems(self) -> list[str]:
        """Check the assembled model: a positive definite stiffness, and a natural frequency within the analysed band."""
        if np.linalg.eigvalsh(self.model().stiffness_matrix()).min() <= 0:
            subject = "effects: with them the structure" if self.effects else "structure: it"
            return [f"{subject} would not stand (its stiffness is not positive)"]
        low, high = self.selection.min_frequency_hz, self.processing.cutoff_hz
        hz = self.model().modes().frequencies_hz
        if hz[0] > high or hz[-1] < low:
            where = "beyond cutoff_hz" if hz[0] > high else f"below {low:g} Hz (selection.min_frequency_hz)"
            return [f"structure: every natural frequency lies {where}; are masses in kg, stiffness in N/m?"]
        return []

    def _effect(self, table: EffectTable) -> Effect:
        if table.effect not in FORMS:
            raise EffectError(f"unknown effect {table.effect!r}; known: {', '.join(sorted(FORMS))}")
        effect = FORMS[table.effect].create(table.location, table.parameters)
        effect.check(self.drawn.structure(), self.channels)
        return effect

    @property
    def floor_sensors(self) -> tuple[SensorTable, ...]:
        """Sensors by which the structure is judged: accelerometers along the model's direction; without a model, all of them."""
        axes = (
            ("x", "y") if isinstance(self.structure, BuildingTable) else ("x",) if self.has_model else ("x", "y", "z")
        )
        return tuple(s for s in self.sensors if s.along in axes)

    @property
    def witnesses(self) -> tuple[SensorTable, ...]:
        """Sensors that enter no estimate: of another quantity or axis than the model's."""
        return tuple(s for s in self.sensors if s not in self.floor_sensors)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channel names of the sensors by which the structure is judged, in the structure file's order."""
        return tuple(s.channel for s in self.floor_sensors)

    @property
    def site_name(self) -> str:
        """Name of the site in messages and keys: `site.name`, else the structure's name, else ``site``."""
        return self.site.name or self.structure.name or "site"

    @property
    def has_model(self) -> bool:
        """Whether masses and stiffnesses are drawn; without them the modes alone are monitored."""
        return not isinstance(self.structure, ModalTable)

    @property
    def drawn(self) -> DrawnTable:
        """The structure as drawn, in the directions that its sensors see; raises `BadConfigurationError` if nothing is."""
        table = self.structure
        if isinstance(table, ModalTable):
            raise BadConfigurationError(NO_MODEL)
        return table.completed(self.storeys, self._only_axis) if isinstance(table, BuildingTable) else table

    @property
    def _only_axis(self) -> Literal["x", "y"] | None:
        """The one direction of a building that its sensors see, where nothing couples that to another; else None."""
        axes = {s.axis or "x" for s in self.floor_sensors} | {i.axis for i in self.inputs}
        across = 1 if "x" in axes else 0
        turns = any(s.position_m[across] for s in self.floor_sensors)
        if len(axes) > 1 or turns or any(s.eccentricity_m[across] for s in self.storeys):
            return None
        return "x" if "x" in axes else "y"

    def model(self) -> Model:
        """Build the nominal model with the effects of the file."""
        table = self.drawn
        effects = tuple(self._effect(t) for t in self.effects)
        return Model(table.structure(), effects, table.correction(), table.modal_damping())

    @property
    def story_names(self) -> tuple[str, ...]:
        """What people call each stiffness: its number, with its name where the structure file has one; none without a model."""
        return () if isinstance(self.structure, ModalTable) else self.drawn.names

    @property
    def unwatched(self) -> tuple[int, ...]:
        """Stories of which nothing is said: those that the owner left out, and those of directions that no sensor sees."""
        hidden = self.instrumented().hidden_stiffnesses() if self.storeys else ()
        return tuple(sorted({*self.alarm.unwatched, *hidden}))

    @property
    def drawing(self) -> Drawing:
        """The structure as it is drawn: by its ``[[nodes]]`` and ``[[lines]]``, else by what its kind tells of its form."""
        if self.nodes:
            return Drawing.of(self.nodes, self.lines)
        if self.has_model:
            return self.drawn.drawing()
        return Drawing.of_channels([s.label or s.channel for s in self.floor_sensors])

    @property
    def size_words(self) -> str:
        """What the model consists of, in words: ``3 stories``, or ``6 stiffnesses, 12 degrees of freedom``."""
        if not self.has_model:
            return "no model, the modes alone"
        structure = self.drawn.structure()
        stories, dofs = structure.n_stories, structure.n_dofs
        if isinstance(structure, ShearFrame):
            return f"{stories} {'story' if stories == 1 else 'stories'}"
        if isinstance(structure, Building):
            along = ", ".join(DIRECTION_WORDS[d] for d in structure.directions)
            return f"{structure.n_masses} storey{'s' * (structure.n_masses > 1)}, counted from the ground, {along}"
        stiffnesses = "1 stiffness" if stories == 1 else f"{stories} stiffnesses"
        return f"{stiffnesses}, {dofs} degree{'s' if dofs > 1 else ''} of freedom"

    @property
    def forced(self) -> tuple[int, ...]:
        """Degree of freedom on which each measured force acts, from 1."""
        if self.inputs and isinstance(self.structure, BuildingTable):
            structure = self.drawn.structure()
            return tuple(place_index(f"floor {i.floor} {i.axis}", structure) + 1 for i in self.inputs)
        return tuple(i.floor for i in self.inputs)

    def front_end(self) -> FrontEnd:
        """Create the front end that turns samples of the source into windows and segments."""
        return FrontEnd(
            self.channels,
            self.processing,
            self.refinement.segment_s,
            n_lags=2 * self.identification.block_rows,
            forces=tuple(zip([i.channel for i in self.inputs], self.forced, strict=True)),
        )

    def instrumented(self) -> InstrumentedModel:
        """Build the nominal model with its sensors and the prior standard deviations of its parameters."""
        drawn, samples, structure = self.drawn, self.processing, self.drawn.structure()
        floors: tuple[int | str, ...] = tuple(s.floor for s in self.floor_sensors if s.floor is not None)
        rows = None
        if isinstance(structure, Building):
            on = self.floor_sensors
            rows = np.array(
                [structure.sensor_row(s.floor or 1, "y" if s.axis == "y" else "x", s.position_m) for s in on]
            )
            places = zip(floors, (s.axis or "x" for s in on), (s.position_m for s in on), strict=True)
            floors = tuple(f"{floor} along {axis} at {x:g}, {y:g} m" for floor, axis, (x, y) in places)
        return InstrumentedModel(
            self.model(),
            self.channels,
            floors,
            drawn.prior_std(),
            name=drawn.name,
            kind=drawn.kind,
            rate_hz=samples.rate_hz,
            cutoff_hz=samples.cutoff_hz,
            rows=rows,
            boxes=self._boxes(),
        )

    def _boxes(self) -> tuple[tuple[int, int], ...]:
        """Find the channels along x and along y at one place of a building."""
        at = {(s.floor, s.position_m, s.axis or "x"): i for i, s in enumerate(self.floor_sensors)}
        pairs = [(i, at.get((floor, place, "y"))) for (floor, place, axis), i in at.items() if axis == "x"]
        return tuple((x, y) for x, y in pairs if y is not None)


def _twice(names: Iterable[str]) -> list[str]:
    """Say which names stand twice."""
    return [f"{name!r} stands twice" for name, count in sorted(Counter(names).items()) if count > 1]


def read_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a TOML file; raises `MissingInputError` or `BadConfigurationError`."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            raise BadConfigurationError(f"{path}: not UTF-8 text, so no TOML file") from error
        raise MissingInputError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a number of thousands of digits is a ValueError too
        json_text = "; it looks like JSON: a structure file is TOML, a baseline belongs to --baseline"
        remedy = json_text if text.lstrip()[:1] == "{" else ""
        raise BadConfigurationError(f"{path}: not a TOML file: {error}{remedy}") from error


def load_with_model(path: Path) -> Configuration:
    """Load the settings of a structure file or a site file that has a model, as `load`."""
    config = load(path)
    if not config.has_model:
        raise BadConfigurationError(f"{path}: {NO_MODEL}")
    return config


def load(path: Path) -> Configuration:
    """Load and validate the settings of a structure file or a site file.

    Raises `MissingInputError` if the file, or a matrix file that it names, cannot be read, and `BadConfigurationError` if they
    are invalid; its message lists every problem, one a line.
    """
    tables = read_toml(path)
    if isinstance(tables.get("structure"), dict):
        tables["structure"] = read_matrices(tables["structure"], path.parent)
    problems: list[str] = []
    try:
        config = read_settings(Configuration, tables)
    except ValidationError as error:
        problems += settings_problems(error)
    except RecursionError as error:
        raise BadConfigurationError(f"{path}: its tables are nested too deeply") from error
    if isinstance(tables.get("source"), dict):
        channels = () if problems else config.channels
        try:
            make_source(tables["source"], SourceContext(channels, path.parent))
        except BadConfigurationError as error:
            problems += str(error).split("\n")
    if problems:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in problems))
    return config


def make_source(table: Mapping[str, Any], context: SourceContext) -> Source:
    """Create the driver of a ``[source]`` table, without opening it (errors as `load`)."""
    try:
        driver = source_type(str(table.get("kind", "")))
        settings = read_settings(driver.Settings, table)
        source: Source = driver(settings, context)
        return source
    except UnknownSourceError as error:
        raise BadConfigurationError(f"source.kind: {error}") from error
    except ImportError as error:
        raise BadConfigurationError(f"source.kind: {table['kind']!r} cannot be loaded: {error}") from error
    except ValidationError as error:
        raise BadConfigurationError("\n".join(settings_problems(error, "source"))) from error
    except (OSError, ValueError, SourceError) as error:
        raise BadConfigurationError(f"source: {error}") from error


def make_bounds(table: Mapping[str, Any] | None) -> LiveBounds | None:
    """Create the bounds of a valid ``[source]`` table on its data; None where it sets none, or the source is not live."""
    if table is None or table.keys().isdisjoint(LiveSettings.model_fields):
        return None
    settings = read_settings(source_type(str(table["kind"])).Settings, table)
    return LiveBounds(settings) if isinstance(settings, LiveSettings) else None
