import sys

from aniso_pm.cli import main

sys.exit(main())
