"""Recipes: which weather a scene gets, in YAML with units and ranges, checked before any drawing.

`recipes.load.load_recipe` reads a file or a preset into a `RecipeTemplate`; its `resolve(variant)`
draws a `recipes.schema.Recipe`, which holds numbers only.
"""
