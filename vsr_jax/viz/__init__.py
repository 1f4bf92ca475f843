"""Pictures: arms, strains, workspaces, films, designs, with matplotlib, in one style.

The public face imports these modules when they are first used.
"""
