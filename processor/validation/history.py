"""The history of all nights: one SQLite file that can be kept for years.

A cell is written with its figures in one transaction, so that cells are whole whatever ends the program. Primary keys
allow one row for a figure of a cell in a night. The journal is a rollback journal, not WAL: the history is then one
file, which can be copied, cached, or lie on a network's disk.

View ``rows`` has one row for every figure of every night, with all that made it.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processor.language.messages import Text
from processor.model import InputError, Statistic
from processor.store.codec import value_from_json, value_to_json
from processor.validation.cells import Cell, Origin, Outcome, checks_of
from processor.validation.software_identity import Software

VERSION = 3  # of the tables below
# Columns added by version. Earlier figures have no statistic: certificates are of the present software.
ADDED = {2: ("figures.quantity", "figures.statistic", "figures.better", "nights.message"), 3: ("cells.origin",)}
ADD = "ALTER TABLE {} ADD COLUMN {} TEXT NOT NULL DEFAULT ''"
UPGRADES = {
    version: tuple(ADD.format(*name.split(".")) for later in ADDED if later > version for name in ADDED[later])
    for version in range(1, VERSION)
}
BUSY_S = 60.0  # another night may write for some seconds
SCHEMA = """
CREATE TABLE nights (
  night TEXT PRIMARY KEY,             -- YYYY-MM-DD
  code TEXT NOT NULL,                 -- digest of the sources and the libraries' versions
  commit_ TEXT NOT NULL,              -- git's; + where files differed from it
  software TEXT NOT NULL,             -- JSON, versions by name
  matrix TEXT NOT NULL, matrix_sha256 TEXT NOT NULL,
  begun TEXT NOT NULL,                -- UTC
  ended TEXT,                         -- NULL until all of it is done
  line TEXT NOT NULL DEFAULT '',
  message TEXT NOT NULL DEFAULT ''    -- JSON, the line as a text with values
) WITHOUT ROWID;
CREATE TABLE cells (
  night TEXT NOT NULL REFERENCES nights ON DELETE CASCADE, cell TEXT NOT NULL, case_ TEXT NOT NULL,
  title TEXT NOT NULL, recipe TEXT NOT NULL, recipe_sha256 TEXT NOT NULL, settings TEXT NOT NULL,
  seed INTEGER NOT NULL, fixed INTEGER NOT NULL, input_sha256 TEXT NOT NULL, failed TEXT NOT NULL,
  seconds REAL NOT NULL, peak_mb REAL NOT NULL, origin TEXT NOT NULL DEFAULT '',
  PRIMARY KEY (night, cell)
) WITHOUT ROWID;
CREATE TABLE figures (
  night TEXT NOT NULL, cell TEXT NOT NULL, step TEXT NOT NULL, method TEXT NOT NULL, name TEXT NOT NULL,
  value REAL, limit_ REAL, unit TEXT NOT NULL,        -- NULL = not a number, no limit
  quantity TEXT NOT NULL DEFAULT '', statistic TEXT NOT NULL DEFAULT '', better TEXT NOT NULL DEFAULT '',
  PRIMARY KEY (night, cell, step, method, name),
  FOREIGN KEY (night, cell) REFERENCES cells ON DELETE CASCADE
) WITHOUT ROWID;
CREATE TABLE changes (
  night TEXT NOT NULL REFERENCES nights ON DELETE CASCADE, step TEXT NOT NULL, method TEXT NOT NULL, name TEXT NOT NULL,
  kind TEXT NOT NULL, said TEXT NOT NULL, accepted INTEGER NOT NULL DEFAULT 0,
  PRIMARY KEY (night, step, method, name)
) WITHOUT ROWID;
CREATE VIEW rows AS SELECT f.night, c.title, f.step, f.method, f.name, f.value, f.limit_, f.unit, c.recipe,
  c.recipe_sha256, c.settings, c.seed, c.fixed, c.input_sha256, n.software, n.commit_, n.code, n.matrix, f.cell, c.case_
  FROM figures f JOIN cells c USING (night, cell) JOIN nights n USING (night);
"""
Name = tuple[str, str, str]  # of a figure: step, method, name


@dataclass(frozen=True)
class Row:
    """One figure of one cell in one night, input of the test of changes."""

    night: str
    case: str
    recipe: str
    seed: int
    fixed: bool
    input_sha256: str
    name: Name
    value: float
    unit: str
    quantity: str = ""
    statistic: str = ""
    better: str = ""
    origin: str = Origin.OWN


Scene = tuple[str, int]  # case and seed
Figures = dict[str, Row]  # of one quantity in one scene, by statistic
Quantity = tuple[str, str, str, str]  # origin, step, method, and name


def by_quantity(rows: Iterable[Row], nights: Collection[str]) -> dict[Quantity, dict[Scene, Figures]]:
    """Group the figures of ``nights``; of a scene that several nights have, as fixed seeds are, the last one counts."""
    found: dict[Quantity, dict[Scene, Figures]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row.night in nights and row.statistic:
            found[row.origin, row.name[0], row.name[1], row.quantity][row.case, row.seed][row.statistic] = row
    return found


def of_items(scenes: Iterable[Figures], statistic: Statistic) -> tuple[float, list[tuple[float, float]]]:
    """Return a statistic of all items of scenes together, NaN without any, and (value, number) of each scene's.

    Scenes without a value or without items are left out.
    """
    pairs = [
        (scene[statistic].value, scene[Statistic.NUMBER].value)
        for scene in scenes
        if statistic in scene and Statistic.NUMBER in scene
    ]
    pairs = [(value, number) for value, number in pairs if math.isfinite(value) and number > 0.0]
    whole = sum(number for _, number in pairs)
    return (sum(value * number for value, number in pairs) / whole if whole else math.nan), pairs


class History:
    """An open history. Raises InputError for a file that is no history, or one of a later version."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Transactions are begun and ended explicitly.
            self.db = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None)
            self.db.execute("PRAGMA foreign_keys = ON")
            self.db.execute("PRAGMA synchronous = FULL")
            with self._transaction():
                (version,) = self.db.execute("PRAGMA user_version").fetchone()
                if version == 0 and not self.db.execute("SELECT name FROM sqlite_master").fetchall():
                    for statement in SCHEMA.split(";\n"):
                        self.db.execute(statement)
                    version = VERSION
                for statement in UPGRADES.get(version, ()):
                    self.db.execute(statement)
                    version = VERSION
                self.db.execute(f"PRAGMA user_version = {version}")
        except (sqlite3.Error, OSError) as error:
            raise InputError(f"{path}: expected a history of nights, could not open it ({error})") from error
        if version != VERSION:
            self.close()
            raise InputError(f"{path}: expected a history of version {VERSION}, found {version}; name another file")

    def close(self) -> None:
        """Close the file."""
        self.db.close()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self.db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self.db.execute("ROLLBACK")
            raise
        self.db.execute("COMMIT")

    # --- the present night -----------------------------------------------------------------------------------------

    def begun_by(self, night: str) -> str | None:
        """Return the digest of the software that began a night; None if there is no such night."""
        row = self.db.execute("SELECT code FROM nights WHERE night = ?", [night]).fetchone()
        return None if row is None else str(row[0])

    def begin(self, night: str, software: Software, matrix: str, matrix_sha256: str, now: str) -> None:
        """Begin a night, or continue it."""
        with self._transaction():
            self.db.execute(
                "INSERT INTO nights (night, code, commit_, software, matrix, matrix_sha256, begun)"
                " VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT (night) DO UPDATE SET ended = NULL",
                [night, software.code, software.commit, _json(software.versions), matrix, matrix_sha256, now],
            )

    def forget(self, night: str) -> None:
        """Delete a night, which is to be done again by other software."""
        with self._transaction():
            self.db.execute("DELETE FROM nights WHERE night = ?", [night])

    def done(self, night: str) -> set[str]:
        """Return the keys of the cells of a night that are done and did not fail."""
        return {
            str(cell) for (cell,) in self.db.execute("SELECT cell FROM cells WHERE night = ? AND failed = ''", [night])
        }

    def add(self, night: str, cell: Cell, outcome: Outcome) -> None:
        """Write a cell with its figures, in place of an earlier attempt that failed."""
        case = cell.case
        checks = [] if outcome.failed else checks_of(outcome.results)
        with self._transaction():
            self.db.execute("DELETE FROM cells WHERE night = ? AND cell = ? AND failed != ''", [night, cell.key])
            added = self.db.execute(
                "INSERT INTO cells (night, cell, case_, title, recipe, recipe_sha256, settings, seed, fixed,"
                " input_sha256, failed, seconds, peak_mb, origin)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
                [night, cell.key, case.key, cell.title, case.recipe, case.recipe_sha256, _json(case.settings),
                 cell.seed, int(cell.fixed), str(outcome.results.get("input_sha256", "")), outcome.failed,
                 outcome.seconds, outcome.peak_mb, str(case.origin)],
            )  # fmt: skip
            if added.rowcount:
                self.db.executemany(
                    "INSERT INTO figures"
                    " (night, cell, step, method, name, value, limit_, unit, quantity, statistic, better) VALUES"
                    " (:night, :cell, :step, :method, :name, :value, :limit, :unit, :quantity, :statistic, :better)",
                    [{**check, "night": night, "cell": cell.key} for check in checks],
                )

    def end(self, night: str, changes: Iterable[tuple[Name, str, dict[str, Any]]], line: Text, now: str) -> None:
        """End a night with its changes: the name of the figure, the kind of change, and the change as an object."""
        with self._transaction():
            accepted = set(self._names("SELECT step, method, name FROM changes WHERE night = ? AND accepted", night))
            self.db.execute("DELETE FROM changes WHERE night = ?", [night])
            self.db.executemany(
                "INSERT INTO changes VALUES (?, ?, ?, ?, ?, ?, ?)",
                [[night, *name, str(kind), _json(change), int(name in accepted)] for name, kind, change in changes],
            )
            self.db.execute(
                "UPDATE nights SET line = ?, message = ?, ended = ? WHERE night = ?",
                [str(line), _json(_text_object(line)), now, night],
            )

    def accept(self, night: str) -> int:
        """Accept what got worse in a night as the new level; returns the number of figures."""
        with self._transaction():
            return self.db.execute(
                "UPDATE changes SET accepted = 1 WHERE night = ? AND kind IN ('regression', 'lost') AND NOT accepted",
                [night],
            ).rowcount

    # --- queries -----------------------------------------------------------------------------------------------------

    def nights(self) -> list[dict[str, Any]]:
        """Return all nights, the earliest first: night, code, commit, ended, line, and the line as a message or None.

        ``ended`` is "" for a night that has not, ``message`` None of a history without it.
        """
        found = self._select(
            "SELECT night, code, commit_ AS 'commit', IFNULL(ended, '') AS ended, line, message FROM nights"
            " ORDER BY night"
        )
        return [{**one, "message": _text_of(json.loads(one["message"])) if one["message"] else None} for one in found]

    def rows(self, first: str, last: str) -> list[Row]:
        """Return the figures of the nights from ``first`` to ``last``, the earliest first."""
        found = self._select(
            "SELECT step, method, name, value, fixed, origin, night, case_ AS 'case', recipe, seed, input_sha256, unit,"
            " quantity, statistic, better FROM figures JOIN cells USING (night, cell) WHERE night BETWEEN ? AND ?"
            " ORDER BY night, case_, seed, step, method, name",
            first,
            last,
        )
        return [
            Row(
                name=(one.pop("step"), one.pop("method"), one.pop("name")),
                value=math.nan if (value := one.pop("value")) is None else value,
                fixed=bool(one.pop("fixed")),
                origin=one.pop("origin") or Origin.OWN,
                **one,
            )
            for one in found
        ]

    def settings(self, first: str, last: str) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Return the recipe and the settings ``key=value`` of each case of the nights from ``first`` to ``last``."""
        return {
            case: (recipe, tuple(json.loads(settings)))
            for case, recipe, settings in self.db.execute(
                "SELECT DISTINCT case_, recipe, settings FROM cells WHERE night BETWEEN ? AND ?", [first, last]
            )
        }

    def missed(self, night: str) -> list[dict[str, Any]]:
        """Return the figures of a night beyond their limits: cell, step, method, name, value, limit and unit."""
        return self._select(
            "SELECT cell, step, method, name, value, limit_ AS 'limit', unit FROM figures"
            " WHERE night = ? AND limit_ IS NOT NULL AND (value IS NULL OR value > limit_)",
            night,
        )

    def cells(self, night: str) -> list[dict[str, Any]]:
        """Return the cells of a night: title, case, failed, seconds, peak_mb, fixed, seed and figures (a number)."""
        return self._select(
            "SELECT cell, title, case_ AS 'case', failed, seconds, peak_mb, fixed, seed, (SELECT COUNT(*) FROM figures"
            " f WHERE f.night = c.night AND f.cell = c.cell) AS figures FROM cells c WHERE night = ?"
            " ORDER BY title, cell",
            night,
        )

    def worse(self, before: str) -> dict[Name, set[str]]:
        """Return the nights before in which a figure was worse and not accepted: they are no level to compare with."""
        nights: dict[Name, set[str]] = {}
        for night, step, method, name in self.db.execute(
            "SELECT night, step, method, name FROM changes"
            " WHERE night < ? AND kind IN ('regression', 'lost') AND NOT accepted",
            [before],
        ):
            nights.setdefault((step, method, name), set()).add(night)
        return nights

    def _select(self, query: str, *values: str) -> list[dict[str, Any]]:
        """Return rows by the names of their columns."""
        found = self.db.execute(query, values)
        return [dict(zip((name for name, *_ in found.description), row, strict=True)) for row in found]

    def _names(self, query: str, *values: str) -> list[Name]:
        return [(step, method, name) for step, method, name in self.db.execute(query, values)]


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, sort_keys=True)


def _text_object(message: Any) -> Any:
    """Return a text as JSON holds it, with the texts and words among its values."""
    if not isinstance(message, Text):
        return value_to_json(message)
    values = None if message.values is None else {key: _text_object(value) for key, value in message.values.items()}
    return {"template": message.template, "values": values}


def _text_of(stored: Any) -> Any:
    if not isinstance(stored, dict) or "template" not in stored:
        return value_from_json(stored)
    values = stored["values"]
    return Text(stored["template"], values and {key: _text_of(value) for key, value in values.items()})
