"""The live viewer: a scene in the browser, rendered by the training renderer."""
