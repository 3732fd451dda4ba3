"""Candidates in parallel on a GPU: rolled out, and differentiated, in eager torch.

The peer is the compiled rollout on one thread of the processor.

Run from the repository's root: `python benchmarks/gpu.py [--candidates 10000 100000]`. Says so
where no GPU is present; `--device cpu` tries the same on the processor.
"""

import argparse
import sys
import time
from collections.abc import Callable

import cases
import torch
from torch import Tensor

from nfriction import rollout


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> tuple[float, float]:
    """Median seconds with the device's queue drained, and its peak memory [MB] (0 on a CPU)."""
    cuda = device.type == "cuda"
    times = []
    for k in range(repeats + 1):
        if cuda:
            torch.cuda.synchronize(device)
            torch.cuda.reset_peak_memory_stats(device)
        start = time.perf_counter()
        work()
        if cuda:
            torch.cuda.synchronize(device)
        if k:  # the first run loads kernels
            times.append(time.perf_counter() - start)
    memory = torch.cuda.max_memory_allocated(device) / 1e6 if cuda else 0.0
    return sorted(times)[len(times) // 2], memory


def agreement(dtype: torch.dtype, device: torch.device, steps: int) -> float:
    """Largest difference of a few positions from the CPU's float64 rollout [rad]."""
    q0, qd0 = cases.release(8)
    expected = rollout(cases.rig(), cases.neurofuzzy(), q0, qd0, steps=steps, gradients=False).q
    plant, model = cases.rig().to(device, dtype), cases.neurofuzzy().to(device, dtype)
    given = (x.to(device, dtype) for x in (q0, qd0))
    found = rollout(plant, model, *given, steps=steps, gradients=False, backend="torch").q
    return float((found.cpu().double() - expected).abs().max())


def measure_compiled(count: int, steps: int, repeats: int) -> None:
    plant, model = cases.rig(), cases.neurofuzzy().requires_grad_(False)
    q0, qd0 = cases.release(count)

    def forward() -> Tensor:
        return rollout(plant, model, q0, qd0, steps=steps, gradients=False, backend="compiled").q

    seconds, _ = timed(forward, torch.device("cpu"), repeats)
    print(f"  {count:7,}  float64  {'one thread, compiled':21} {seconds:8.3f} s  "
          f"{count * steps / seconds / 1e6:8.2f} M steps/s", flush=True)  # fmt: skip


def measure(count: int, dtype: torch.dtype, device: torch.device, steps: int, repeats: int) -> None:
    plant, model = cases.rig().to(device, dtype), cases.neurofuzzy().to(device, dtype)
    q0, qd0 = (x.to(device, dtype) for x in cases.release(count))

    def forward() -> Tensor:
        return rollout(plant, model, q0, qd0, steps=steps, gradients=False, backend="torch").q

    def backward() -> None:
        model.zero_grad(set_to_none=True)
        motion = rollout(plant, model, q0, qd0, steps=steps, gradients=True)
        motion.q.square().mean().backward()

    if forward().device.type != device.type:
        raise SystemExit(f"the rollout left {device}")
    for label, work in (("rollout", forward), ("rollout and gradient", backward)):
        try:
            seconds, memory = timed(work, device, repeats)
        except torch.cuda.OutOfMemoryError:
            print(f"  {count:7,}  {str(dtype)[6:]:8} {label:21} does not fit the device's memory")
            torch.cuda.empty_cache()
            continue
        print(f"  {count:7,}  {str(dtype)[6:]:8} {label:21} {seconds:8.3f} s  "
              f"{count * steps / seconds / 1e6:8.2f} M steps/s  {memory:8.0f} MB",
              flush=True)  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, nargs="+", default=[10_000, 30_000, 100_000])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("no GPU present (torch.cuda.is_available() is false): nothing measured")
        return 0
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the processor"
    print(f"neuro-fuzzy friction, three links, {options.steps} steps on {name}, "
          f"torch {torch.__version__}")  # fmt: skip
    for count in options.candidates:
        measure_compiled(count, options.steps, options.repeats)
    for dtype in (torch.float64, torch.float32):
        difference = agreement(dtype, device, options.steps)
        print(f"  {str(dtype)[6:]}: within {difference:.1e} rad of the processor's float64")
        for count in options.candidates:
            measure(count, dtype, device, options.steps, options.repeats)
    return 0


if __name__ == "__main__":
    sys.exit(main())
