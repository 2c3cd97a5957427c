from starcat.database.diff import Difference as Difference
from starcat.database.manifest import MANIFEST_NAME as MANIFEST_NAME
from starcat.database.manifest import read_manifest as read_manifest
from starcat.database.reader import open_database_folder as open_database_folder
from starcat.database.verify import check_database as check_database
