"""Other programs that solve the same problems, and the suite that times them beside jaxctrl.

`jaxctrl bench peers` runs it, from a checkout. Nothing here imports JAX before the suite does.
"""
