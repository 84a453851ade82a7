"""`make gpu-check`: one command that checks the CUDA backend on this GPU and measures its speed.

It builds nothing and needs no network. Without a GPU it rehearses the same checks, tiny, on an emulated one.
"""
