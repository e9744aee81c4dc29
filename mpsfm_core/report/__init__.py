"""The page that shows a finished result folder.

It reads that folder and nothing else, so that it can be made anew at any time
(``mpsfm report DIR``), and it is one file that opens without a server or a network.
"""
