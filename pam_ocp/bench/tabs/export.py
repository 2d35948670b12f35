"""The tab Export: FMU, SSP, C code, script, study and report of all that the session holds."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

from nicegui import ui

from .. import elements as el
from .. import script, study
from ..jobs import export as jobs
from ..tab import Tab

__all__ = ["Export"]

Said = dict[str, Any]
FMI = {"2.0": "FMI 2.0", "3.0": "FMI 3.0"}


class Export(Tab):
    """What leaves the page."""

    title = "Export"
    parts = ("data", "chosen", "muscle", "plant", "point", "motions", "controllers", "exports")

    def build(self) -> None:
        self._made: dict[str, Said] = {}
        self._checked: Said | None = None
        with el.split():
            with el.side():
                with el.section("FMU and SSP"):
                    self._fmu_box = ui.element("div")
                with el.section("C code of a controller"):
                    self._c_box = ui.element("div")
                with el.section("Report"):
                    self._report_box = ui.element("div")
                with el.section("Session"):
                    el.note("All of it in one file: state, dropped files, script, study.")
                    el.button("Download the session", self._download_all)
            with el.plots():
                with el.section("Exported", wide=True):
                    self._list = ui.element("div")
                with el.section("Python script", "repeats all that was done here", wide=True):
                    with ui.element("div").classes("bench-row"):
                        el.button("Download script", self._download_script)
                        el.button("Run it and compare", self._check_soon, main=True)
                    self._verdict = el.note("", "bench-verdict")
                    self._verdict._props["aria-live"] = "polite"
                    self._rows = ui.element("div")
                    self._script = el.tag("pre", "", "bench-pre bench-code", tabindex="0")
                    self._script._props["aria-label"] = "the script"
                with el.section("Study", "for pam-ocp study", wide=True):
                    with ui.element("div").classes("bench-row"):
                        el.button("Download study", self._download_study)
                    self._study = el.tag("pre", "", "bench-pre bench-code", tabindex="0")
                    self._study._props["aria-label"] = "the study file"
        self.update(frozenset(self.parts))

    def update(self, changed: frozenset[str]) -> None:
        self._checked = None
        with self.bench.shown_errors():
            self._show()

    @staticmethod
    def lines(state: Said) -> Sequence[str]:
        return script.export_lines(state)

    # ---- drawing --------------------------------------------------------------------------------
    def _show(self) -> None:
        self._script.set_text(self.bench.script())
        self._study.set_text(self._study_text())
        for box in (self._fmu_box, self._c_box, self._report_box, self._list):
            box.clear()
        ready = self.state["muscle"] is not None
        with self._fmu_box:
            self._fmu_fields() if ready else el.note("Choose or fit a muscle first.")
        with self._c_box:
            self._c_fields()
        with self._report_box:
            if ready:
                el.button("Write report", lambda: self.bench.soon(self._report))
            else:
                el.note("Choose or fit a muscle first.")
        with self._list:
            self._table()
        self._show_check()

    def _remembered(self, name: str, default: Any) -> Any:
        return self.bench.session.view("Export", name, default)

    def _fmu_fields(self) -> None:
        remember = self.bench.session.remember
        motions = {m["id"]: m["name"] for m in self.state["motions"]}
        usual = next(reversed(motions), "")
        chosen = self._remembered("motion", usual)
        self._motion = chosen if chosen in motions else usual
        self._fmi = str(self._remembered("fmi", "2.0"))
        self._step = float(self._remembered("step", 1e-3))
        cross = find_spec("ziglang") is not None  # the extra [cross]
        self._platforms = str(self._remembered("platforms", "windows" if cross else "native"))

        def keep(name: str, field: str, value: Any) -> None:
            setattr(self, field, value)
            remember("Export", **{name: value})

        el.choice("Standard", FMI, self._fmi, lambda v: keep("fmi", "_fmi", v))
        el.Field(
            "Step",
            self._step,
            "s",
            lambda v: keep("step", "_step", v),
            low=1e-5,
            high=1.0,
            shown="ms",
        )
        kinds = {key: words for key, (words, _) in script.PLATFORMS.items()}
        act = partial(keep, "platforms", "_platforms")
        hint = "others than this machine need the cross compiler: pip install 'pam_ocp[cross]'"
        el.choice("Runs on", kinds, self._platforms, act, hint)
        against = {**motions, "": "the operating point"}
        el.choice("Held against", against, self._motion, lambda v: keep("motion", "_motion", v))
        with ui.element("div").classes("bench-row").style("margin-top: 6px"):
            el.button("Export FMU and check it", lambda: self._start("fmu"), main=True)
            el.button("Export SSP", lambda: self._start("ssp"))

    def _c_fields(self) -> None:
        controllers = {c["id"]: c["name"] for c in self.state["controllers"]}
        if not controllers or not self.state["point"]:
            el.note("Design a controller in the tab Control first.")
        else:
            self._controller = next(reversed(controllers))

            def choose(id: str) -> None:
                self._controller = id

            el.choice("Controller", controllers, self._controller, choose)
            el.button("Export C code", lambda: self._start("c"))

    def _table(self) -> None:
        exports = self.state["exports"]
        if not exports:
            el.note("Nothing yet.")
            return
        for said in exports:
            made = self._made.get(said["id"])
            path = self.bench.folder / "exports" / said["file"]
            with ui.element("div").classes("bench-row"):
                el.tag("span", said["file"])
                el.tag("span", f"{said['size'] / 1024:.4g} KiB", "bench-note")
                ok = said["ok"]
                if said["kind"] == "fmu":
                    words = "checked: all well" if ok else "checked: NOT well"
                    el.tag("span", words, "bench-good" if ok else "bench-bad")
                if path.is_file():
                    el.button(
                        f"Download {said['file']}",
                        lambda path=path: self.bench.download(path.read_bytes(), path.name),
                    )
                el.button("Remove", lambda id=said["id"]: self._remove(id))
            if made is not None and said["kind"] == "fmu":
                el.tag("pre", made["words"], "bench-pre bench-code")

    # ---- doing ----------------------------------------------------------------------------------
    def _told_state(self) -> Said:
        return {**self.state, "views": {"figures": self.state["views"].get("figures", {})}}

    def _start(self, kind: str) -> None:
        self.bench.soon(lambda: self._export(kind))

    async def _export(self, kind: str) -> None:
        session = self.bench.session
        said: Said = {"id": session.fresh_id("exports"), "kind": kind, "motion": ""}
        if kind == "c":
            said["controller"] = self._controller
        else:
            said |= {"fmi": self._fmi, "step_size": self._step, "motion": self._motion}
            said["platforms"] = self._platforms
        function = {"fmu": jobs.fmu, "ssp": jobs.ssp, "c": jobs.c_code}[kind]
        made = await self.bench.work(
            f"Export {kind.upper()}",
            function,
            self.bench.folder,
            self._told_state(),
            said,
            self.bench.allow_code,
            warm="plan",
            time_limit=600.0,
        )
        self._made[said["id"]] = made
        if "figures" in made:
            session.remember("figures", **{said["id"]: {"of": None, "values": made["figures"]}})
        kept = {k: made[k] for k in ("file", "size", "ok")}
        session.put(f"export {made['file']}", "exports", {**said, **kept})

    def _remove(self, id: str) -> None:
        with self.bench.shown_errors():
            self.bench.session.drop(f"remove {id}", "exports", id)

    async def _report(self) -> None:
        made = await self.bench.work(
            "Report",
            jobs.report,
            self.bench.folder,
            self._told_state(),
            self.bench.session.title,
            self.bench.allow_code,
            warm="plan",
        )
        path = self.bench.folder / "exports" / made["file"]
        self.bench.download(path.read_bytes(), path.name)

    # ---- script and study -----------------------------------------------------------------------
    def _study_text(self) -> str:
        bench = self.bench
        return study.study_of(bench.folder, self.state, bench.session.title, bench.allow_code)

    def _download_script(self) -> None:
        with self.bench.shown_errors():
            self.bench.download(self.bench.script(), "session.py")

    def _download_study(self) -> None:
        with self.bench.shown_errors():
            self.bench.download(self._study_text(), "session.toml")

    def _download_all(self) -> None:
        """The folder, with script and study as they are now."""
        with self.bench.shown_errors():
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
                folder = self.bench.folder
                for part in ("files", "exports"):
                    for file in sorted((folder / part).glob("*")):
                        archive.write(file, f"{part}/{file.name}")
                archive.write(folder / "session.json", "session.json")
                archive.writestr("session.py", self.bench.script())
                archive.writestr("session.toml", self._study_text())
                if study.needs_muscle_file(self.state):
                    muscle = study.save_muscle_file(folder, self.state)
                    archive.write(muscle, muscle.name)
            self.bench.download(packed.getvalue(), f"{self.bench.session.id}.zip")

    def _check_soon(self) -> None:
        self.bench.soon(self._check)

    async def _check(self) -> None:
        self._checked = None
        self._show_check()
        found = await self.bench.work(
            "Run the script",
            jobs.script_checked,
            self.bench.folder,
            self._told_state(),
            self.bench.script(),
            self.bench.allow_code,
            warm="plan",
            time_limit=1800.0,
        )
        self._checked = found
        self._show_check()

    def _show_check(self) -> None:
        self._rows.clear()
        self._verdict.classes(remove="bench-good bench-bad")
        if self._checked is None:
            self._verdict.set_text("")
            return
        rows = self._checked["rows"]
        wrong = [row["name"] for row in rows if not row["ok"]]
        if self._checked["ok"]:
            words = f"The script gives all {len(rows)} figures of this page, to {jobs.AGREES:g}."
        elif not rows:
            words = "There are no figures yet."
        else:
            words = f"{len(wrong)} of {len(rows)} figures differ: {', '.join(wrong[:5])}"
        self._verdict.set_text(words)
        self._verdict.classes("bench-good" if self._checked["ok"] else "bench-bad")
        with self._rows:
            shown = [
                [
                    row["name"],
                    _said(row["page"]),
                    _said(row["script"]),
                    "same" if row["ok"] else "NOT",
                ]
                for row in rows
            ]
            el.table(
                ["figure [SI]", "page", "script", "agrees"], shown, label="Figures, page and script"
            )


def _said(value: float | None) -> str:
    return "missing" if value is None else f"{value:.12g}"
