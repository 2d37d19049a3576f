"""How Blender draws splats: geometry nodes that put an ellipsoid or a point on each, and their two materials."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy

COLOUR = "splat_color"  # a point's attribute named "color" is black in Cycles
RADIUS = "point_radius"  # attribute: of a splat shown as a point; 0 is not shown
GROUP, MATERIAL, POINT_MATERIAL = "3D-GIMP splats", "3D-GIMP splat", "3D-GIMP point"
EXTENT = 3.0  # standard deviations drawn


class Graph:
    """Builds a node tree."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self._tree = tree

    def add(self, kind: str, inputs: Mapping[Any, Any] | None = None, **settings: Any) -> bpy.types.Node:
        """A new node with its settings. Inputs, by name or number, are sockets that are linked, or values."""
        node = self._tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self._tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def attribute(self, name: str, kind: str) -> bpy.types.NodeSocket:
        """A named attribute of the geometry."""
        return self.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind).outputs["Attribute"]

    def compare(self, operation: str, a: bpy.types.NodeSocket, b: Any) -> bpy.types.NodeSocket:
        return self.add("FunctionNodeCompare", {"A": a, "B": b}, data_type="FLOAT", operation=operation).outputs[0]

    def both(self, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.add("FunctionNodeBooleanMath", {0: a, 1: b}, operation="AND").outputs[0]


def node_group() -> bpy.types.NodeTree:
    """Geometry nodes that put an ellipsoid, or in the viewport a point, on every splat; one group for all objects."""
    if GROUP in bpy.data.node_groups:
        return bpy.data.node_groups[GROUP]
    tree = bpy.data.node_groups.new(GROUP, "GeometryNodeTree")
    tree.is_modifier = True
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    points = tree.interface.new_socket("As Points", in_out="INPUT", socket_type="NodeSocketBool")
    points.description = "Show points instead of ellipsoids in the viewport: fast for millions; renders are the same"
    fraction = tree.interface.new_socket("Fraction", in_out="INPUT", socket_type="NodeSocketFloat")
    fraction.default_value, fraction.min_value, fraction.max_value = 1.0, 0.0, 1.0
    fraction.description = "Share of the splats to show"
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    graph = Graph(tree)
    given = graph.add("NodeGroupInput").outputs
    lottery = graph.add("FunctionNodeRandomValue", data_type="FLOAT").outputs["Value"]
    chosen = graph.compare("LESS_EQUAL", lottery, given["Fraction"])
    shapes = {
        "False": _ellipsoids(graph, given["Geometry"], chosen),
        "True": _points(graph, given["Geometry"], chosen),
        "Switch": graph.both(given["As Points"], graph.add("GeometryNodeIsViewport").outputs[0]),
    }
    shown = graph.add("GeometryNodeSwitch", shapes, input_type="GEOMETRY").outputs["Output"]
    graph.add("NodeGroupOutput", {"Geometry": shown})
    return tree


def _ellipsoids(graph: Graph, splats: bpy.types.NodeSocket, chosen: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    ball = graph.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0, "Subdivisions": 2}).outputs["Mesh"]
    painted = graph.add("GeometryNodeSetMaterial", {"Geometry": ball, "Material": splat_material()})
    extent = {0: graph.attribute("scale", "FLOAT_VECTOR"), "Scale": EXTENT}
    placed = {
        "Points": splats,
        "Selection": chosen,
        "Instance": painted.outputs["Geometry"],
        "Rotation": graph.attribute("rotation", "QUATERNION"),
        "Scale": graph.add("ShaderNodeVectorMath", extent, operation="SCALE").outputs[0],
    }
    return graph.add("GeometryNodeInstanceOnPoints", placed).outputs["Instances"]


def _points(graph: Graph, splats: bpy.types.NodeSocket, chosen: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    radius = graph.attribute(RADIUS, "FLOAT")
    drawn = graph.both(chosen, graph.compare("GREATER_THAN", radius, 0.0))
    dots = graph.add("GeometryNodeMeshToPoints", {"Mesh": splats, "Selection": drawn, "Radius": radius})
    painted = {"Geometry": dots.outputs["Points"], "Material": point_material()}
    return graph.add("GeometryNodeSetMaterial", painted).outputs["Geometry"]


def splat_material() -> bpy.types.Material:
    """Emission of a splat's colour with falloff: opacity · exp(−d²/2), d the ray's distance to the centre."""
    if MATERIAL in bpy.data.materials:
        return bpy.data.materials[MATERIAL]
    material = _blank_material(MATERIAL)
    material.surface_render_method = "BLENDED"
    graph = Graph(material.node_tree)

    def math(operation: str, *inputs: Any) -> bpy.types.NodeSocket:
        return graph.add("ShaderNodeMath", dict(enumerate(inputs)), operation=operation).outputs[0]

    def dot(a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return graph.add("ShaderNodeVectorMath", {0: a, 1: b}, operation="DOT_PRODUCT").outputs["Value"]

    def of_instance(name: str, output: str) -> bpy.types.NodeSocket:
        node = graph.add("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=name)
        return node.outputs[output]

    geometry, place = graph.add("ShaderNodeNewGeometry").outputs, graph.add("ShaderNodeTexCoord").outputs["Object"]
    spaces = {"vector_type": "VECTOR", "convert_from": "WORLD", "convert_to": "OBJECT"}
    to_object = graph.add("ShaderNodeVectorTransform", {0: geometry["Incoming"]}, **spaces).outputs[0]
    along = dot(place, graph.add("ShaderNodeVectorMath", {0: to_object}, operation="NORMALIZE").outputs[0])
    distance = math("SUBTRACT", dot(place, place), math("MULTIPLY", along, along))
    falloff = math("EXPONENT", math("MULTIPLY", distance, -0.5 * EXTENT**2))
    front = math("SUBTRACT", 1.0, geometry["Backfacing"])
    alpha = math("MULTIPLY", math("MULTIPLY", falloff, of_instance("opacity", "Fac")), front)
    emission = graph.add("ShaderNodeEmission", {"Color": of_instance(COLOUR, "Color")}).outputs[0]
    clear = graph.add("ShaderNodeBsdfTransparent").outputs[0]
    mix = graph.add("ShaderNodeMixShader", {"Fac": alpha, 1: clear, 2: emission})
    graph.add("ShaderNodeOutputMaterial", {"Surface": mix.outputs[0]})
    return material


def point_material() -> bpy.types.Material:
    """Opaque emission of a point's colour. A point is no instance, so it carries its colour itself."""
    if POINT_MATERIAL in bpy.data.materials:
        return bpy.data.materials[POINT_MATERIAL]
    material = _blank_material(POINT_MATERIAL)
    graph = Graph(material.node_tree)
    colour = graph.add("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name=COLOUR).outputs["Color"]
    emission = graph.add("ShaderNodeEmission", {"Color": colour}).outputs[0]
    graph.add("ShaderNodeOutputMaterial", {"Surface": emission})
    return material


def _blank_material(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # Blender < 5.0
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material
