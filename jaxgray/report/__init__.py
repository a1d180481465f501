"""What is told of results: documents, terminal, page, figures, exports.

documents    JSON documents, and what is read back
rows, identification_rows, diagnosis_rows    tables that terminal, page and notebook share
terminal, diagnosis_terminal, notebook
page         the page in one file
figures      figures for papers
exports      models for other programs
templates    of the page
"""
