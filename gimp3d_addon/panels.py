"""The N-panel 3D-GIMP: four steps that say what is missing and offer the button that mends it."""

from __future__ import annotations

import textwrap
import time
from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel

from . import charts, jobs, splats, steps
from .chosen import current_splat
from .operators.base import RunsChild
from .operators.display import unfit_settings
from .operators.remove import source_in
from .operators.roi import FITS, proposed
from .worker import COMPILING, duration

LINE = 38  # characters that fit into the panel's default width


class InTab:
    """Mixin: a panel of the tab 3D-GIMP."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "3D-GIMP"


class Advanced(InTab):
    """Mixin: a closed sub-panel."""

    bl_options = {"DEFAULT_CLOSED"}


class StepPanel(InTab):
    """Mixin: a step, with a tick in its header once nothing is missing."""

    step = staticmethod(steps.scene_step)

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        step = self.step(context)
        self.layout.label(text="", icon="ERROR" if step.missing or step.warning else "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        step = self.step(context)
        self.choose(self.layout, context)
        if step.facts:
            self.layout.label(text=" · ".join(step.facts))
        if step.hint:
            say(self.layout, step.hint, "INFO")
        if step.missing or step.warning:
            say(self.layout, step.missing or step.warning, "ERROR")
            for fix in step.fixes:
                button(self.layout, fix)
        self.act(self.layout, context)

    def choose(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """What is chosen, above what is known of it."""

    def act(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """The step's buttons."""


def say(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """A message in as many lines as it needs."""
    column = layout.column(align=True)
    for k, line in enumerate(textwrap.wrap(text, LINE)):
        column.label(text=line, icon="BLANK1" if k else icon)


def button(layout: bpy.types.UILayout, fix: steps.Fix) -> None:
    made = layout.operator(fix.operator, text=fix.label, icon="FORWARD")
    for name, value in fix.options.items():
        setattr(made, name, value)


class GIMP3D_PT_scene(StepPanel, bpy.types.Panel):
    """The splats"""

    bl_label = "1  Scene"
    step = staticmethod(steps.scene_step)

    def choose(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        layout.prop(context.scene.gimp3d, "splat", text="")

    def act(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        if current_splat(context) is not None:
            row = layout.row(align=True)
            row.operator("gimp3d.import_ply", text="Import")
            row.operator("gimp3d.export_ply", text="Export")


class GIMP3D_PT_display(Advanced, bpy.types.Panel):
    """How the splats are shown in Blender"""

    bl_label = "Display"
    bl_parent_id = "GIMP3D_PT_scene"

    def draw(self, context: bpy.types.Context) -> None:
        layout, splat, view = self.layout, current_splat(context), context.space_data
        if view is not None and view.shading.type in ("SOLID", "WIREFRAME"):
            say(layout, "Solid view shows no colours:", "INFO")
        if view is not None:
            layout.row(align=True).prop(view.shading, "type", expand=True)
        for name, text in zip(splats.DISPLAY, ("Points in Viewport", "Share of Splats")):
            found = splats.display_input(splat, name) if splat is not None else None
            if found is not None:
                layout.prop(*found, text=text)
        layout.operator("gimp3d.update_colours")
        row = layout.row(align=True)
        row.operator("gimp3d.render_view")
        row.operator("gimp3d.hide_previews", text="", icon="X")
        for problem in unfit_settings(context.scene):
            say(layout, problem, "INFO")
        if unfit_settings(context.scene):
            layout.operator("gimp3d.prepare_render")


class GIMP3D_PT_region(StepPanel, bpy.types.Panel):
    """The box round the object"""

    bl_label = "2  Region"
    step = staticmethod(steps.region_step)

    def choose(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        for index, roi in enumerate(context.scene.gimp3d.rois):
            if roi.object is not None:
                row = layout.row(align=True)
                row.prop(roi.object, "name", text="", icon="MESH_CUBE")
                row.operator("gimp3d.forget_roi", text="", icon="X").index = index

    def act(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        layout.label(text="Add Box")
        row = layout.row(align=True)
        for fit, _, _, icon, _ in FITS:
            row.operator("gimp3d.add_roi", text=fit.capitalize(), icon=icon).fit = fit
        layout.operator("gimp3d.use_selected")


class GIMP3D_PT_views(StepPanel, bpy.types.Panel):
    """From where the scene is looked at"""

    bl_label = "3  Views"
    step = staticmethod(steps.views_step)

    def choose(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        settings = context.scene.gimp3d
        layout.prop(settings, "views", text="")
        if settings.views == "COLLECTION":
            layout.prop(settings, "view_collection", text="")

    def act(self, layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        step = self.step(context)
        if step.missing:
            return
        if not step.warning:  # else both are offered already
            row = layout.row(align=True)
            row.operator("gimp3d.add_views", text="Orbit")
            row.operator("gimp3d.import_cameras", text="Import")
        row = layout.row(align=True)
        row.operator("gimp3d.look_through", text="Previous", icon="TRIA_LEFT").step = -1
        row.operator("gimp3d.look_through", text="Next", icon="TRIA_RIGHT").step = 1


class GIMP3D_OT_add_preset(AddPresetBase, bpy.types.Operator):
    """Keep the preset, the fill and the seed under a name, or delete the chosen one"""

    bl_idname = "gimp3d.add_preset"
    bl_label = "Keep Removal Preset"
    preset_menu = "GIMP3D_PT_presets"
    preset_subdir = "gimp3d"
    preset_defines = ("settings = bpy.context.scene.gimp3d",)
    preset_values = ("settings.preset", "settings.inpaint", "settings.depth_prior", "settings.seed")


class GIMP3D_PT_presets(PresetPanel, bpy.types.Panel):
    """The user's own named settings"""

    bl_label = "Removal Presets"
    preset_subdir = "gimp3d"
    preset_operator = "script.execute_preset"
    preset_add_operator = "gimp3d.add_preset"


class GIMP3D_PT_remove(InTab, bpy.types.Panel):
    """Run it"""

    bl_label = "4  Remove"

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        GIMP3D_PT_presets.draw_panel_header(self.layout)

    def draw(self, context: bpy.types.Context) -> None:
        settings, layout, running = context.scene.gimp3d, self.layout, RunsChild.running
        layout.prop(settings, "preset", text="")
        if running is not None:
            layout.progress(factor=running.worker.progress, text=running.bl_label)
            say(layout, running.said(context), "TIME")
            layout.operator("gimp3d.cancel", icon="CANCEL")
            return
        self._before(layout, context)
        if jobs.unfinished(context) is not None:
            say(layout, "A removal was stopped half-way", "INFO")
            layout.operator("gimp3d.resume", icon="PLAY")
        if source_in(context) is not None:
            row = layout.row(align=True)
            row.operator("gimp3d.compare", icon="ARROW_LEFTRIGHT")
            row.operator("gimp3d.restore", icon="LOOP_BACK")
            if settings.verdict:
                layout.progress(factor=settings.score, text=f"Score {settings.score:.2f}")
                for words in settings.verdict.split("\n"):
                    say(layout, words, "INFO")
        if settings.last_report and jobs.is_own_report(Path(settings.last_report)):
            opened = layout.operator("wm.url_open", text="Open Report", icon="URL")
            opened.url = Path(settings.last_report).as_uri()

    @staticmethod
    def _before(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
        """What it will cost, and the button; or what to do first."""
        settings, told = context.scene.gimp3d, steps.forecast(context)
        panels = (GIMP3D_PT_scene, GIMP3D_PT_region, GIMP3D_PT_views)
        found = [(p.bl_label, p.step(context)) for p in panels]
        missing = next((f for f in found if f[1].missing), None)
        if missing is None and told is not None:
            cost = f"about {duration(told.seconds * settings.pace)}, {told.memory_mb / 1000:.1f} GB"
            layout.label(text=cost, icon="TIME")
            if jobs.is_first():
                layout.label(text=f"On a first run {duration(COMPILING)} more", icon="INFO")
            if settings.hole:
                layout.label(text=f"Hole: {settings.hole}", icon="MOD_MASK")
        if missing is not None:
            title, step = missing
            say(layout, f"Step {title[0]} first: {step.missing}", "ERROR")
            for fix in step.fixes[:1]:
                button(layout, fix)
        for _, step in found if missing is None else ():
            if step.warning:
                say(layout, step.warning, "ERROR")
                button(layout, step.fixes[0])
        count = proposed(context)[0]
        if count:
            say(layout, f"The box cuts the object: {count:,} splats of it stay", "INFO")
            layout.operator("gimp3d.enlarge_roi", icon="FULLSCREEN_ENTER")
        layout.prop(settings, "grow")
        layout.prop(settings, "shadow")
        if settings.shadow == "mask":
            layout.operator("gimp3d.paint_shadow", icon="BRUSH_DATA")
        if settings.shadow_found:
            say(layout, settings.shadow_found, "LIGHT_SUN")
        row = layout.row(align=True)
        row.enabled = missing is None
        row.operator("gimp3d.preview_masks", icon="MOD_MASK")
        row = layout.row()
        row.enabled, row.scale_y = missing is None, 1.5
        row.operator("gimp3d.remove_object", icon="TRASH")


class GIMP3D_PT_reference(Advanced, bpy.types.Panel):
    """From where the picture is completed first, and by whom"""

    bl_label = "Reference View"
    bl_parent_id = "GIMP3D_PT_remove"

    def draw(self, context: bpy.types.Context) -> None:
        settings, layout = context.scene.gimp3d, self.layout
        if settings.reference is None:
            layout.label(text="Chosen by the program", icon="INFO")
        layout.prop(settings, "reference", text="")
        layout.operator("gimp3d.choose_reference")
        for chart in charts.of_scene(context.scene):
            layout.operator("gimp3d.look_through", text=f"Look at {chart.name}", icon="VIEW_ORTHO").camera = chart.name
        layout.label(text="Paint it without the object")
        row = layout.row(align=True)
        row.operator("gimp3d.export_reference", text="Export")
        row.operator("gimp3d.load_reference", text="Load")
        layout.operator("gimp3d.paint_reference", icon="BRUSH_DATA")
        layout.prop(settings, "reference_image")
        layout.prop(settings, "reference_paint")


class GIMP3D_PT_fill(Advanced, bpy.types.Panel):
    """Who invents what no view shows"""

    bl_label = "Fill"
    bl_parent_id = "GIMP3D_PT_remove"

    def draw(self, context: bpy.types.Context) -> None:
        for name in ("inpaint", "depth_prior", "seed"):
            self.layout.prop(context.scene.gimp3d, name)
        if context.scene.gimp3d.inpaint.startswith("gemini"):
            self.layout.label(text="Google gets pictures, and bills each", icon="INFO")


class GIMP3D_PT_jobs(Advanced, bpy.types.Panel):
    """The folders of this file's removals"""

    bl_label = "Job Folders"
    bl_parent_id = "GIMP3D_PT_remove"

    def draw(self, context: bpy.types.Context) -> None:
        layout, found = self.layout, jobs.of_file(context)
        lost = jobs.of_lost_files()
        if lost:
            layout.label(
                text=f"{len(lost)} jobs of files that are gone · {jobs.size(lost) / 1e6:,.0f} MB", icon="GHOST_DISABLED"
            )
            layout.operator("gimp3d.delete_jobs", text="Delete Them").lost = True
        if not found:
            layout.label(text="None of this file", icon="INFO")
            return
        layout.label(text=f"{len(found)} jobs · {jobs.size(found) / 1e6:,.0f} MB", icon="DISK_DRIVE")
        for record in reversed(found):
            row = layout.row(align=True)
            ago = duration(time.time() - record.started)
            stopped = " · stopped" if record.open else ""
            row.label(text=f"{Path(record.folder).name} · {jobs.size([record]) / 1e6:,.0f} MB · {ago} ago{stopped}")
            row.operator("gimp3d.delete_jobs", text="", icon="TRASH").folder = record.folder
        layout.operator("gimp3d.delete_jobs", text="Delete All but the Newest")
