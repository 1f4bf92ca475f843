"""Pictures: arms, strains, workspaces, films, designs, with matplotlib.

The public face imports these modules when they are first used.
"""
