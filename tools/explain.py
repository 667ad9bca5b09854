"""The plan of a recipe on a scene, for people and for machines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any


def explain_recipe(recipe: str, scene_uri: str, variant: int = 0) -> dict[str, Any]:
    """Resolved numbers, plan and scene facts that decide what is rendered."""
    from adapters.base import open_scene
    from augment.plan import make_plan
    from recipes.load import load_recipe

    template = load_recipe(recipe)
    resolved = template.resolve(variant)
    scene = open_scene(scene_uri)
    plan = make_plan(resolved, scene)
    return {
        "recipe": resolved.model_dump(mode="json"),
        "recipe_hash": resolved.hash,
        "variants": template.variants,
        "scene": {
            "name": scene.name,
            "source": scene.source,
            "cameras": list(scene.camera_names),
            "frames": len(scene.frames),
        },
        "plan": plan.as_dict(),
    }


def explanation_text(facts: dict[str, Any]) -> str:
    """The facts of `explain_recipe` as a page of text."""
    recipe, scene, plan = facts["recipe"], facts["scene"], facts["plan"]
    images = len(scene["cameras"]) * scene["frames"] * facts["variants"]
    lines = [
        f"recipe {recipe['name']}, variant {recipe['variant']} of {facts['variants']}, "
        f"seed {recipe['seed']}, hash {facts['recipe_hash']}",
        f"scene  {scene['name']} ({scene['source']}): {len(scene['cameras'])} cameras x "
        f"{scene['frames']} frames, {images} images in all variants",
        "",
        "effects in numbers:",
    ]
    effects = {"style": recipe["style"], **recipe["weather"]}
    effects = {name: numbers for name, numbers in effects.items() if numbers}
    lines += [
        f"  {path} = {value}" for name in effects for path, value in _flat(name, effects[name])
    ] or ["  none: this is the clean render"]
    lines += ["", "passes, in order:"]
    width = max(len(step["name"]) for step in plan["steps"])
    lines += [
        f"  {'runs ' if step['runs'] else 'skips'}  {step['name']:<{width}}  {step['why']}"
        for step in plan["steps"]
    ]
    return "\n".join(lines)


def _flat(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Every number below a field with its dotted path; what is not given is left out."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _flat(f"{path}.{name}", inner)
    elif isinstance(value, (list, tuple)) and any(isinstance(v, dict) for v in value):
        for number, inner in enumerate(value):
            yield from _flat(f"{path}[{number}]", inner)
    elif value is not None:
        yield path, value
