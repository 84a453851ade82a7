"""A scene in a browser, drawn by the renderer that trains it."""
