"""The posterior beyond its Gaussian: emulated J, walkers, Markov chains, the measure of its shape."""
