"""Write the report page of a finished result folder, and show scenes in viewers.

The report needs only the result folder, so ``mpsfm report DIR`` can write the page again at any
time. The report page is one HTML file that opens without a server or network.
"""
