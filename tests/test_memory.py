"""`keep_memory`: in a process of its own, since it holds for a whole one."""

import platform
import subprocess
import sys

import pytest

SCRIPT = """
import resource, jax, jax.numpy as jnp
import shapeenh as se
taken = {call}
double = jax.jit(lambda x: 2 * x)
given = jnp.ones(1 << 24)
for _ in range(3):
    double(given).block_until_ready()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    double(given).block_until_ready()
print(taken, (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 4)
"""


@pytest.mark.parametrize("call", ["se.keep_memory()", "None"])
def test_kept_memory_is_not_touched_for_the_first_time_again(call):
    """An array of 64 MiB has 16384 pages: none of them is new where the C library can keep them."""
    done = subprocess.run([sys.executable, "-c", SCRIPT.format(call=call)], capture_output=True, text=True, check=True)
    taken, faults = done.stdout.split()
    if platform.libc_ver()[0] != "glibc":
        assert taken in ("False", "None")
    elif taken == "True":
        assert int(faults) < 200
    else:
        assert taken == "None"
        assert int(faults) > 200  # else this test shows nothing
