"""Compile loops for the CPU as whole functions: an application's choice, made at its start."""

import os
import sys
import warnings

_OPTION = "xla_backend_extra_options"
_WHOLE_LOOPS = "xla_cpu_small_while_loop_byte_threshold=1000000000"
_DEVICES = "xla_force_host_platform_device_count"


def enable_fast_cpu(num_devices: int | None = None) -> bool:
    """Let XLA compile each loop into one native function: a solve becomes 2 to 8 times faster.

    By default XLA runs the body of a loop operation by operation, at some 50 ns each, which for the
    small matrices of a movement is most of the time. This sets an option in the environment
    variable XLA_FLAGS, which XLA reads when it is first used: call it before anything is computed,
    and before any array is made; `jax.config.update` may come first. It speaks for the whole
    process, and changes results by rounding only. Programs for a GPU are not affected.

    Arguments:
        num_devices: how many devices the CPU is to be split into, at least 1; `solve_batch` uses
            them in parallel. As many as there are cores is a good choice; by default left as it is.

    Returns: whether it will take effect. A UserWarning tells when it comes too late.

    Raises ValueError for a number of devices below 1.
    """
    if num_devices is not None and num_devices < 1:
        raise ValueError(f"num_devices: at least 1 is wanted, got {num_devices}")
    flags = os.environ.get("XLA_FLAGS", "").split()
    wanted = list(flags)
    if not any(_WHOLE_LOOPS.split("=")[0] in flag for flag in flags):
        given = [flag for flag in flags if flag.startswith(f"--{_OPTION}=")]
        wanted = [flag for flag in flags if flag not in given]
        options = [flag.split("=", 1)[1] for flag in given] + [_WHOLE_LOOPS]
        wanted.append(f"--{_OPTION}=" + ",".join(options))
    if num_devices is not None:
        wanted = [flag for flag in wanted if not flag.startswith(f"--{_DEVICES}=")]
        wanted.append(f"--{_DEVICES}={num_devices}")
    if wanted == flags:
        return True
    if _is_live():
        warnings.warn(
            "enable_fast_cpu: too late, JAX has already been used in this process; call it before "
            "anything is computed",
            stacklevel=2,
        )
        return False
    os.environ["XLA_FLAGS"] = " ".join(wanted)
    return True


def _is_live() -> bool:
    """Tell whether XLA has read its flags. JAX does not say so in public: if unknown, not."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bool(getattr(bridge, "backends_are_initialized", lambda: False)())
