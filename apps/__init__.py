"""The network apps.  They share the files of this folder, which are the contract between them, and never import each other."""
