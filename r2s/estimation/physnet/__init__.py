"""PhysNet: an embedding of depth images of fabrics in which similar fabrics lie close together.

After Duan, Boyd, Aragon-Camarasa and Aizawa 2022 ("Learning physics properties of fabrics and
garments with a physics similarity neural network").
"""
