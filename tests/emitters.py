"""Which of XLA's emitters compile the processes that a test starts."""

import os


def as_users_compile(**variables: str) -> dict[str, str]:
    """Returns the environment of a process with XLA's current fusion emitters. The older ones, which make
    tests fast (conftest.py), round differently in programs for different numbers of devices."""
    flags = os.environ.get("XLA_FLAGS", "")
    for flag in ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"):
        flags = flags.replace(flag, "")
    return os.environ | {"XLA_FLAGS": flags} | variables
