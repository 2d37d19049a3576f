"""What every operator does: find the scene's objects, run the core in a child, and say a failure in one line.

A failure is one line to the user, CANCELLED to the caller (a RuntimeError in scripts).
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from bpy.props import BoolProperty, IntProperty

from gimp3d.errors import BadInput, Gimp3dError

from .. import trust
from ..chosen import current_boxes, current_splat
from ..installation import preferences
from ..worker import Worker

FAILURES = (Gimp3dError, OSError)  # what a user can act on; anything else is a bug and keeps its traceback
AGAIN = {"PASS_THROUGH"}  # another child follows
LONGEST = 1500  # characters of what a dialogue can show in full
TICK = 0.1  # s between two looks at the child's progress


def one_line(error: Exception) -> str:
    """An error as the command line would say it."""
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
    return f"gimp3d: error: {text}"


class Need(NamedTuple):
    """What has to be there before an operator can be called."""

    words: str  # what to do if it is not
    is_there: Callable[[bpy.types.Context], Any]


SPLAT = Need("Step 1: import a splat scene", lambda context: current_splat(context) is not None)
BOX = Need("Step 2: put a box round the object", lambda context: current_boxes(context))
CAMERA = Need("Make a camera active first", lambda context: context.scene.camera is not None)


class Needs:
    """Mixin: the operator's button is grey until all that it needs is there, and says what is not."""

    needs: tuple[Need, ...] = ()

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        missing = next((need for need in cls.needs if not need.is_there(context)), None)
        if missing is not None:
            cls.poll_message_set(missing.words)
        return missing is None


class ReportsErrors(Needs):
    """Mixin: `execute` runs `work` and reports a failure as one line."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.work(context)
        except FAILURES as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class Edits(ReportsErrors):
    """Mixin: changes the scene at once, and may be undone."""

    bl_options = {"REGISTER", "UNDO"}


class RunsChild(Needs):
    """Mixin: `start` prepares files and starts a child, `collect` takes its result, beside a Blender that stays free.

    `execute` (scripts, background) waits for the end. In the window Esc or the panel's button cancels at once.
    """

    running: RunsChild | None = None  # the one that runs beside Blender now; two would fight for the processor
    worker: Worker
    in_window = False  # the user pressed a button: Blender must stay free. Else a script waits for the end
    _shown = ""

    def start(self, context: bpy.types.Context) -> Worker:
        """Write what the child needs and start it."""
        raise NotImplementedError

    def collect(self, context: bpy.types.Context) -> Worker | None:
        """Take the result of a child that ended; may start another one, and is then called again."""
        raise NotImplementedError

    def tidy(self) -> None:
        """Whatever the end: files that nobody needs any more."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        if RunsChild.running is not None:
            return self._failed(BadInput(f"{RunsChild.running.bl_label} is still running; cancel it first"))
        try:
            self.worker = self.start(context)
        except FAILURES as error:
            return self._failed(error)
        if self.in_window:
            self._go(context)
            context.window_manager.modal_handler_add(self)
            return {"RUNNING_MODAL"}
        answer = AGAIN
        while answer == AGAIN:
            self.worker.join()
            answer = self._end(context)
        return answer

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.in_window = not bpy.app.background
        return self.ask(context, event)

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """What comes first in the window: a file browser or a dialogue, which calls `execute` in the end."""
        return self.execute(context)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self.worker.cancel()
        elif event.type != "TIMER":
            return {"PASS_THROUGH"}
        ended = self.worker.poll()
        said = self.said(context)
        if said != self._shown:  # drawing takes time too
            self._shown = said
            context.workspace.status_text_set(f"3D-GIMP: {said} (Esc cancels)")
            redraw_panels(context)
        if not (ended or self.worker.cancelled):
            return {"PASS_THROUGH"}
        self._stop(context)
        answer = self._end(context)
        if answer == AGAIN:
            self._go(context)
        return answer

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is opened, the window closes, or its dialogue was cancelled."""
        if RunsChild.running is not self:
            return
        self.worker.cancel()
        self._stop(context)
        self.tidy()

    def said(self, context: bpy.types.Context) -> str:
        """The child's progress in words."""
        return self.worker.words(context.scene.gimp3d.pace)

    def _go(self, context: bpy.types.Context) -> None:
        RunsChild.running = self
        self._timer = context.window_manager.event_timer_add(TICK, window=context.window)

    def _stop(self, context: bpy.types.Context) -> None:
        RunsChild.running = None
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        redraw_panels(context)

    def _end(self, context: bpy.types.Context) -> set[str]:
        if self.worker.cancelled:
            self.tidy()
            self.report({"INFO"}, "cancelled; the scene is as it was")
            return {"CANCELLED"}
        try:
            following = self.collect(context)
        except FAILURES as error:
            return self._failed(error)
        if following is not None:
            self.worker = following
            return AGAIN
        self.tidy()
        return {"FINISHED"}

    def _failed(self, error: Exception) -> set[str]:
        self.tidy()
        self.report({"ERROR"}, one_line(error))
        return {"CANCELLED"}


class AsksFirst(RunsChild):
    """Mixin: what the scene's providers would run is shown in full, and confirmed once on each machine.

    Without a window nobody can be asked, so a script has to say that it is allowed.
    """

    allow_command: BoolProperty(
        name="Allow Commands",
        description="Run the command or model that the scene's settings name, unasked: for scripts that know the file",
        options={"HIDDEN", "SKIP_SAVE"},
    )
    _shown: tuple[str, ...] = ()

    def providers(self, context: bpy.types.Context) -> tuple[str, ...]:
        """What the user, or the .blend, chose."""
        settings = context.scene.gimp3d
        return settings.inpaint, settings.depth_prior

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            self._shown = tuple(trust.unconfirmed(self.providers(context)))
            if sum(map(len, self._shown)) > LONGEST:
                raise BadInput("the settings Fill and Surface are too long to be shown, so they cannot be allowed")
        except FAILURES as error:
            self._shown = ()
            return self._failed(error)
        if not self._shown or bpy.app.background:
            return self.execute(context)
        return context.window_manager.invoke_props_dialog(
            self,
            width=560,
            title="This file asks to run something on your machine",
            confirm_text="Allow and Run",
            cancel_default=True,
        )

    def draw(self, context: bpy.types.Context) -> None:
        """All of it: what is cut off could be the part that does harm."""
        column = self.layout.column(align=True)
        for said in self._shown:
            for line in said.splitlines():
                plain = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in line)  # nothing turns it round
                for part in textwrap.wrap(plain, 80, drop_whitespace=False):
                    column.label(text=part)
            column.separator()
        column.label(text="Allow it only if you know it. The preferences list what you allowed.", icon="ERROR")

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self._shown and not bpy.app.background:
            trust.allow(self._shown)
        try:
            strange = trust.unconfirmed(self.providers(context))
            if strange and not self.allow_command:
                what = "; ".join(strange).replace("\n", ", ")
                raise BadInput(
                    f"nobody has allowed this on this machine: {what}; "
                    "Remove Object asks, a script gives allow_command=True"
                )
        except FAILURES as error:
            return self._failed(error)
        return super().execute(context)


class GIMP3D_OT_cancel(Needs, bpy.types.Operator):
    """Stop what is running now; the scene stays as it was"""

    bl_idname = "gimp3d.cancel"
    bl_label = "Cancel"
    needs = (Need("Nothing is running", lambda _: RunsChild.running is not None),)

    def execute(self, context: bpy.types.Context) -> set[str]:
        RunsChild.running.worker.cancel()
        return {"FINISHED"}


def redraw_panels(context: bpy.types.Context) -> None:
    """The panel, not the view: drawing takes time."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if region.type == "UI":
                    region.tag_redraw()


def link(context: bpy.types.Context, obj: bpy.types.Object, collection: bpy.types.Collection | None = None) -> None:
    (collection or context.collection or context.scene.collection).objects.link(obj)


def select_only(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    for other in context.selected_objects:
        other.select_set(False)
    obj.select_set(True)
    context.view_layer.objects.active = obj


def python_of(context: bpy.types.Context) -> str:
    """The chosen Python's path; empty: Blender's own.

    Raises
    ------
    BadInput
        If it depends on where the .blend lies, or Blender was started: another Python could lie there.
    """
    chosen = preferences(context)
    python = chosen.python if chosen else ""
    if python.startswith("//") or (python and not Path(python).is_absolute()):
        raise BadInput(f"the Python {python!r} in the preferences of 3D-GIMP must be a full path; choose it again")
    return python


class GIMP3D_OT_forget_allowed(bpy.types.Operator):
    """Ask again before this is run"""

    bl_idname = "gimp3d.forget_allowed"
    bl_label = "Ask Again"

    index: IntProperty(name="Index", min=0)

    def execute(self, context: bpy.types.Context) -> set[str]:
        for said in trust.allowed()[self.index : self.index + 1]:
            trust.forget(said)
        return {"FINISHED"}


def light_words(shadow: dict[str, Any], reflection: dict[str, Any]) -> str:
    """The shadow and the reflection of a summary, in few words; empty where they were not looked for."""
    words = "No shadow of it is found"
    if shadow["found"]:
        light = ", ".join(f"{x['elevation']:.0f}° high" for x in shadow["lights"])
        words = f"Shadow undone{f' (light {light})' if light else ' as painted'}"
    elif shadow["reason"] == "not looked for":
        words = ""
    return f"{words}, reflection undone" if reflection["found"] else words
