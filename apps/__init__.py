"""The network apps.  They share two files, `messages` and `packets`, and never import each other."""
