"""`climategs view`: a scene in the browser, with a slider for every field of every effect."""
