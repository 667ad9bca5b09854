"""The one error of this package."""


class RecipeError(Exception):
    """A recipe cannot be used: says the file, line, dotted field, value and what is allowed."""
