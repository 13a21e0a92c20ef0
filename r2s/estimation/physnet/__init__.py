"""PhysNet: a network that maps depth images of fabrics to a map where alike fabrics lie close.

After Duan, Boyd, Aragon-Camarasa and Aizawa 2022 ("Learning physics properties of fabrics and
garments with a physics similarity neural network").

- `views`: depth images of points, from where the recording's camera is.
- `preprocess`: from depth to what the network sees, for real and simulated depth alike.
- `dataset`: simulated motions of many fabrics as shards of depth images.
- `network`: the embedding.
- `triplets`: which images are compared, and the loss.
- `training`: epochs, checkpoints, validation.
- `pictures`: the physics similarity map, and learning curves.
"""
