"""PhysNet: an embedding of depth images of fabrics in which similar fabrics lie close together.

After Duan, Boyd, Aragon-Camarasa and Aizawa 2022 ("Learning physics properties of fabrics and
garments with a physics similarity neural network").

- `views`: depth images of points, from the position of the recording's camera.
- `preprocess`: the grey images that the network sees, from measured or simulated depth.
- `dataset`: simulated motions of many fabrics as shards of depth images.
- `network`: the embedding.
- `triplets`: batches, triplets and their loss.
- `training`: epochs, checkpoints, validation.
- `estimator`: the estimate of a fabric from images.
- `search`: a search that continues from its file; `emulator`, `bayes`: what asks for its places, of
  the estimate and of the published recipe.
"""
