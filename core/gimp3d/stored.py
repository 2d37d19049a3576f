"""The results that a stage store can bring back: every class that a stage's result is made of."""

from .box import Box
from .camera import Camera
from .gaussians import Gaussians
from .priors.appearance import Appearance
from .stages.charts import Chart, Hits, Plane
from .stages.clearing import Targets
from .stages.depth import DepthCompletion
from .stages.exposure import Exposure, Exposures
from .stages.ground import Ground
from .stages.growth import Growth
from .stages.lifting import Lifted
from .stages.light_search import Light
from .stages.mapping import MappingField
from .stages.masks import Masks, ViewMasks
from .stages.occluder import Occluder
from .stages.propagate import PaintedView, Propagation
from .stages.reference import ReferenceChoice, ViewScore
from .stages.refine import Refinement
from .stages.reflection import Reflection
from .stages.selection import Selection
from .stages.shadow import Shadow
from .stages.verdict import Verdict
from .stages.view_refinement import RefinedView, ViewRefinement
from .steps.light import Found
from .steps.surfaces import Charted, Surfaces

STORED = (
    Appearance, Box, Camera, Chart, Charted, DepthCompletion, Exposure, Exposures, Found, Gaussians, Ground, Growth,
    Hits, Lifted, Light, MappingField, Masks, Occluder, PaintedView, Plane, Propagation, ReferenceChoice, RefinedView,
    Refinement, Reflection, Selection, Shadow, Surfaces, Targets, Verdict, ViewMasks, ViewRefinement, ViewScore,
)  # fmt: skip
