"""Rain and snowfall: their cost in a frame, and the errors of drawing fewer drops one by one.

Drops that are not drawn one by one become part of a veil. So the means over squares of GRID pixels
must agree, while single pixels differ by the streaks that are left out.
"""

from __future__ import annotations

import cv2

from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from tools.bench.harness import Table
from tools.bench.scenes import CLEAN, EffectCase, cost_tables, recipe_of

# The effects of every measured weather, by its row's name.
CASES = {
    **{f"rain {r:g} mm/h, dry": {"rain": {"rate_mm_h": r, "wetness": 0}} for r in (2.5, 10, 50)},
    "rain 10 mm/h": {"rain": {"rate_mm_h": 10}},
    "rain 50 mm/h": {"rain": {"rate_mm_h": 50}},
    **{f"snowfall {r:g} mm/h": {"snowfall": {"rate_mm_h": r}} for r in (0.3, 1, 4)},
}
# The weathers whose stages and memory are shown.
STAGED = ("rain 10 mm/h, dry", "rain 10 mm/h", "snowfall 1 mm/h")
# The least widths of drops and flakes that are drawn one by one, pixels.
WIDTHS_PX = (0.25, 0.35, 0.5, 1.0, 2.0)
GRID = 32  # The side of the squares whose means are compared, pixels.


def tables(case: EffectCase, repeats: int) -> list[Table]:
    """Measure costs, and errors against pictures with the most drops drawn one by one."""
    costs = {name: (recipe_of(weather), CLEAN) for name, weather in CASES.items()}
    scene, _ = case.open_street()
    camera = case.views(scene, 1.0)[0]
    rows = []
    for name in (STAGED[0], STAGED[2]):
        pictures = []
        for width in WIDTHS_PX:
            ((kind, fields),) = CASES[name].items()
            speed = {f"{kind}_min_width_px": width}
            recipe = recipe_of({kind: fields, "render": {"speed": speed}})
            pictures.append(render_buffers(scene, camera, make_plan(recipe, scene)).rgb.numpy())
        for width, picture in zip(WIDTHS_PX, pictures, strict=True):
            change = 255 * (picture - pictures[0])
            means = cv2.resize(change, None, fx=1 / GRID, fy=1 / GRID, interpolation=cv2.INTER_AREA)
            errors = (abs(change).mean(), abs(change).max(), abs(means).mean())
            rows.append([name, width, *map(float, errors)])
    title = f"Drops drawn one by one, against those of {WIDTHS_PX[0]} px; 1/255: {case.street}"
    columns = ("falls", "min_width_px", "mean error", "largest", f"of means over {GRID} px")
    return [*cost_tables(case, costs, STAGED, repeats), Table(title, columns, rows)]
