"""How eye paths use the photon map: what they leave to it, and what they go on to find.

At a receiver the gathered part of its BSDF (see ``receivers``) leaves a gather point: what arrives
there over two path segments or more is the photon map's. What is left for the path:

global        the gathered part ends there, except for direct light; the walked part goes on.
caustic       the map holds caustics alone: light → walked parts → gathered part. The path goes on
              with both parts, and drops emission and direct light that reach a gathered part over
              one walked part or more, because the map has them.
final_gather  "caustic" up to the first gathered part, "global" from there on.
none          there is no map: path tracing.
survey        "caustic", with what the other uses would have done told apart (see
              ``survey_parts``): for the pilot that chooses between them.

Each light path is counted exactly once in all of them.
"""

from typing import Literal

# A name that is none of these is an error of the type checker wherever it is compared.
Use = Literal["global", "caustic", "final_gather", "none", "survey"]
