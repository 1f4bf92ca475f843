"""The live view: an arm in the browser that is turned by hand.

Knows solved scenes, inverse statics, paths of inputs and designs, and how figures show an arm. Must
not know the command line. The public face imports it when it is first used; only the modules that
make the page need viser.
"""
