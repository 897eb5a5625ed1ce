"""The golden dives, and with which options they are solved."""

from dataclasses import dataclass
from pathlib import Path

DATA = Path(__file__).parents[1] / "data" / "golden"


@dataclass(frozen=True)
class GoldenDive:
    """A short dive: its logs, options for `solve`, and whether it is one of pictures."""

    name: str
    files: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    pictures: bool = False

    @property
    def logs(self) -> list[Path]:
        """The files of the dive."""
        return [DATA / f"{file}.mcap" for file in self.files or (self.name,)]


CAVERN = GoldenDive("cavern")
LAKE = GoldenDive("lake_dead_lamp")
NIGHT_REEF = GoldenDive("night_reef", ("night_reef_a", "night_reef_b"), ("--clock-offset", "0.03"))
BASIN = GoldenDive("basin_damaged")
SURVEY = GoldenDive("survey")
INERTIAL = GoldenDive("cavern_inertial")
OF_PICTURES = (
    GoldenDive("night_reef_pictures", pictures=True),
    GoldenDive("lake_pictures", pictures=True),
    GoldenDive("basin_pictures", pictures=True),
)
ALL = (CAVERN, LAKE, NIGHT_REEF, BASIN, SURVEY, *OF_PICTURES)
