"""`make gpu-check`: one command that tells whether the CUDA backend is right and how fast it is here.

It builds nothing and needs no network. Without a GPU it rehearses the same checks, tiny, on an emulated one.
"""
