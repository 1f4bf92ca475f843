"""What acts on an arm, on the nodes of a grid: loads, supports, contacts, laws and friction of
threads.

Each derives from an interface of `mechanics`; `problem` assembles them for a scene. Nothing here
knows how an equilibrium is found.
"""
