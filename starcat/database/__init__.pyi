from starcat.database.diff import Difference as Difference
from starcat.database.manifest import MANIFEST_NAME as MANIFEST_NAME
from starcat.database.manifest import read_manifest as read_manifest
from starcat.database.reader import open_artifact as open_artifact
from starcat.database.verify import check_artifact as check_artifact
