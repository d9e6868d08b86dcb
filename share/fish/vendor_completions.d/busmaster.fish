# Asks the program itself, whichever version that is.
_BUSMASTER_COMPLETE=fish_source busmaster 2>/dev/null | source
