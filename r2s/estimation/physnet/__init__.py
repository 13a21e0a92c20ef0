"""PhysNet: an embedding of depth images of fabrics in which similar fabrics lie close together.

After Duan, Boyd, Aragon-Camarasa and Aizawa 2022 ("Learning physics properties of fabrics and
garments with a physics similarity neural network").

- `images`: depth images of simulations and recordings, from the position of a recording's camera.
- `dataset`: simulated motions of many fabrics as shards of depth images.
- `training`: the network, triplets, epochs and checkpoints.
- `search`: a search of the map that continues from its file. `estimator`: the estimate.
- `method`: the contract of `r2s.estimation.method`.
"""
