"""A sweep on many processes: how mass and damping shape the response to a step of pressure.

`simulate_many` takes a number of processes, any executor of Python, or a client of Dask's cluster.
One case that fails does not stop the others. Here Dask runs two workers on this machine.
"""

import numpy as np

import pam_ocp as pam

plant = pam.HangingLoad("DMSP-20-300", mass=10.0, damping=100.0)
masses, dampings = np.linspace(4.0, 20.0, 16), np.linspace(40.0, 640.0, 16)
cases = pam.simulation.sweep(mass=masses, damping=dampings)
at_rest = {mass: plant.equilibrium({"muscle.command": 2.5e5}, mass=mass) for mass in masses}
for case in cases:
    case["start"] = at_rest[case["parameters"]["mass"]]

# %%
# The guard is for systems on which a worker imports this file.


def run() -> pam.simulation.ManySimulations:
    from distributed import Client, LocalCluster

    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**settings) as cluster, Client(cluster) as client:
        return pam.simulate_many(
            plant,
            cases,
            executor=client,
            inputs={"muscle.command": 3e5},
            duration=2.0,
        )


if __name__ == "__main__":
    found = run()
    print(f"{len(cases)} cases, {len(found.failures)} failures")
    runs = [motion["x"] for motion in found.results]
    over = [100 * (x.max() - x[-1]) / (x[-1] - x[0]) for x in runs]
    figure, ((axes,),) = pam.figures.new_figure(1, size=(7.0, 4.5))
    filled = axes.contourf(dampings, masses, np.reshape(over, (16, 16)), levels=12)
    figure.colorbar(filled, label="overshoot [%]")
    axes.set(xlabel="damping [N s/m]", ylabel="mass [kg]")
    figure.savefig("dask_sweep.png", dpi=120)
