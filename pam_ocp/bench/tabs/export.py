"""The tab Export: FMU, SSP, C code, script, study and report of all that the session holds."""

from __future__ import annotations

import io
import zipfile
from functools import partial
from importlib.util import find_spec
from typing import Any

from nicegui import ui

from .. import elements as el
from .. import script, study
from ..elements import Menu, Number
from ..jobs import export as jobs
from ..made import is_of_now, made_of_export
from ..tab import Tab

Said = dict[str, Any]
STANDARD = Menu("Standard", {"2.0": "FMI 2.0", "3.0": "FMI 3.0"})
STEP = Number("Step", "s", 1e-5, 1.0, shown="ms")
PLATFORMS = Menu(
    "Runs on",
    {key: words for key, (words, _) in script.PLATFORMS.items()},
    "others than this machine need the cross compiler: pip install 'pam_ocp[cross]'",
)
NO_MUSCLE = el.words("Choose or fit a muscle first.")


class Export(Tab):
    """What leaves the page."""

    title = "Export"
    parts = ("data", "chosen", "muscle", "plant", "point", "motions", "controllers", "exports")

    def build(self) -> None:
        self._made: dict[str, Said] = {}
        self._checked: Said | None = None
        with el.split():
            with el.side():
                self._fmu_form = el.form("FMU and SSP")
                self._c_form = el.form("C code of a controller")
                self._report_form = el.form("Report")
                with el.section("Session"):
                    el.note("All of it in one file: state, dropped files, script, study.")
                    el.button("Download the session", self._download_all)
            with el.plots():
                self._list = el.box("Exported", wide=True)
                with el.section("Python script", "repeats all that was done here", wide=True):
                    with el.row():
                        el.button("Download script", lambda: self._download("session.py"))
                        el.button("Run it and compare", self._check, main=True)
                    self._verdict = el.Verdict()
                    self._rows = ui.element("div")
                    self._script = el.tag("pre", "", "bench-pre bench-code", tabindex="0")
                    self._script._props["aria-label"] = "the script"
                with el.section("Study", "for pam-ocp study", wide=True):
                    with el.row():
                        el.button("Download study", lambda: self._download("session.toml"))
                    self._study = el.tag("pre", "", "bench-pre bench-code", tabindex="0")
                    self._study._props["aria-label"] = "the study file"

    def update(self, changed: frozenset[str]) -> None:
        self._checked = None
        self._show()

    # ---- drawing --------------------------------------------------------------------------------
    def _show(self) -> None:
        texts = self._texts
        self._script.set_text(texts["session.py"])
        self._study.set_text(texts["session.toml"])
        ready = self.state["muscle"] is not None
        self._fmu_form.show(self._fmu_rows() if ready else [NO_MUSCLE])
        self._c_form.show(self._c_rows())
        self._report_form.show([el.buttons({"Write report": self._report}) if ready else NO_MUSCLE])
        self._list.clear()
        with self._list:
            self._table()
        self._show_check()

    @property
    def _said(self) -> Said:
        """What an FMU or SSP is made with."""
        motions = [m["id"] for m in self.state["motions"]]
        usual = motions[-1] if motions else ""
        chosen = self.view("motion", usual)
        cross = find_spec("ziglang") is not None  # the extra [cross]
        return {
            "fmi": str(self.view("fmi", "2.0")),
            "step_size": float(self.view("step", 1e-3)),
            "platforms": str(self.view("platforms", "windows" if cross else "native")),
            "motion": chosen if chosen in motions else usual,
        }

    def _fmu_rows(self) -> list[el.Row]:
        said = self._said
        motions = {m["id"]: m["name"] for m in self.state["motions"]}
        against = Menu("Held against", {**motions, "": "the operating point"})
        acts = {
            "Export FMU and check it": partial(self._export, "fmu"),
            "Export SSP": partial(self._export, "ssp"),
        }
        return [
            (STANDARD, said["fmi"], lambda v: self.remember(fmi=v)),
            (STEP, said["step_size"], lambda v: self.remember(step=v)),
            (PLATFORMS, said["platforms"], lambda v: self.remember(platforms=v)),
            (against, said["motion"], lambda v: self.remember(motion=v)),
            el.buttons(acts, main="Export FMU and check it"),
        ]

    def _c_rows(self) -> list[el.Row]:
        controllers = {c["id"]: c["name"] for c in self.state["controllers"]}
        if not controllers or not self.state["point"]:
            return [el.words("Design a controller in the tab Control first.")]
        self._controller = next(reversed(controllers))
        menu = Menu("Controller", controllers)
        return [
            (menu, self._controller, lambda id: setattr(self, "_controller", id)),
            el.buttons({"Export C code": partial(self._export, "c")}),
        ]

    def _table(self) -> None:
        exports = self.state["exports"]
        if not exports:
            el.note("Nothing yet.")
            return
        for said in exports:
            made = self._made.get(said["id"])
            path = self.session.folder / "exports" / said["file"]
            with el.row():
                el.tag("span", said["file"])
                el.tag("span", f"{said['size'] / 1024:.4g} KiB", "bench-note")
                if not is_of_now(self.state, said):
                    el.tag("span", "made of earlier values: export it again", "bench-bad")
                elif said["kind"] == "fmu":
                    ok = said["ok"]
                    words = "checked: all well" if ok else "checked: NOT well"
                    el.tag("span", words, "bench-good" if ok else "bench-bad")
                if path.is_file():
                    el.button(f"Download {said['file']}", partial(self.bench.deliver, path))
                drop = partial(self.session.drop, f"remove {said['id']}", "exports", said["id"])
                el.button("Remove", drop)
            if made is not None and said["kind"] == "fmu":
                el.tag("pre", made["words"], "bench-pre bench-code")

    # ---- doing ----------------------------------------------------------------------------------
    async def _export(self, kind: str) -> None:
        said: Said = {"id": self.session.fresh_id("exports"), "kind": kind, "motion": ""}
        said |= {"controller": self._controller} if kind == "c" else self._said
        function = {"fmu": jobs.fmu, "ssp": jobs.ssp, "c": jobs.c_code}[kind]
        of = made_of_export(self.state, said)
        made = await self.work(function, said)
        self._made[said["id"]] = made
        if "figures" in made:
            self.keep_figures(said["id"], of, made["figures"])
        kept = {k: made[k] for k in ("file", "size", "ok")}
        self.session.put(f"export {made['file']}", "exports", {**said, **kept, "of": of})

    async def _report(self) -> None:
        made = await self.work(jobs.report, self.session.title)
        self.bench.deliver(self.world.exported(made["file"]))

    # ---- script and study -----------------------------------------------------------------------
    @property
    def _texts(self) -> dict[str, str]:
        """{file: what stands in it}: the script and the study of all that the session holds."""
        study_file = study.study_of(self.world, self.session.title)
        return {"session.py": script.script_of(self.state), "session.toml": study_file}

    def _download(self, name: str) -> None:
        self.bench.download(self._texts[name], name)

    def _download_all(self) -> None:
        """The folder, with script and study as they are now."""
        packed, folder = io.BytesIO(), self.session.folder
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for part in ("files", "exports"):
                for file in sorted((folder / part).glob("*")):
                    archive.write(file, f"{part}/{file.name}")
            archive.write(folder / "session.json", "session.json")
            for name, text in self._texts.items():
                archive.writestr(name, text)
            if study.needs_muscle_file(self.state):
                muscle = study.save_muscle_file(self.world)
                archive.write(muscle, muscle.name)
        self.bench.download(packed.getvalue(), f"{self.session.id}.zip")

    async def _check(self) -> None:
        self._checked = None
        self._show_check()
        self._checked = await self.work(jobs.script_checked, script.script_of(self.state))
        self._show_check()

    def _show_check(self) -> None:
        self._rows.clear()
        if self._checked is None:
            self._verdict.say()
            return
        rows, ok = self._checked["rows"], bool(self._checked["ok"])
        wrong = [row["name"] for row in rows if not row["ok"]]
        words = f"{len(wrong)} of {len(rows)} figures differ: {', '.join(wrong[:5])}"
        if ok:
            words = f"The script gives all {len(rows)} figures of this page, to {jobs.AGREES:g}."
        elif not rows:
            words = "There are no figures yet."
        self._verdict.say(words, ok)
        shown = [
            [r["name"], _said(r["page"]), _said(r["script"]), "same" if r["ok"] else "NOT"]
            for r in rows
        ]
        heads = ["figure [SI]", "page", "script", "agrees"]
        with self._rows:
            el.table(heads, shown, label="Figures, page and script")


def _said(value: float | None) -> str:
    return "missing" if value is None else f"{value:.12g}"
