"""Benchmark problems with known optima, and how many iterations the solvers take on each.

benchmark = jc.problems.load("cart-pole")    # jc.problems.names() lists them
solution = jc.solve(benchmark.problem, jc.DDP(), benchmark.x0, benchmark.us)
print(benchmark)    # the problem in words, its optimum, and the recorded runs
"""

from ._benchmark import Benchmark as Benchmark, Run as Run, load as load, names as names
