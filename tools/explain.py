"""The plan of a recipe on a scene, for people and for machines."""

from __future__ import annotations

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
        "weather in numbers:",
    ]
    effects = {name: numbers for name, numbers in recipe["weather"].items() if numbers}
    lines += [
        f"  {effect}.{field} = {value}"
        for effect, numbers in effects.items()
        for field, value in numbers.items()
        if value is not None
    ] or ["  none: this is the clean render"]
    lines += ["", "passes, in order:"]
    lines += [
        f"  {'runs ' if step['runs'] else 'skips'}  {step['name']:<20} {step['why']}"
        for step in plan["steps"]
    ]
    return "\n".join(lines)
