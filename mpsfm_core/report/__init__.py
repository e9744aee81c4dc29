"""Report page of a finished result folder, and scenes for viewers.

The report reads only the result folder, so ``mpsfm report DIR`` can write it again at any time. It
is one HTML file that opens without a server or network.
"""
