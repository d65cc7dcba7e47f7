"""What the product computes, done again the slow and obvious way: tests compare with it, benchmarks divide by it.

    afterimage.NaiveAfterImage   Kitsune's features, packet by packet, as published
    kitnet.NaiveKitNet           its autoencoders, one numpy call per step, as published
    sonata                       the queries of the catalogue over a whole capture

Nothing here imports what it is compared with.
"""
