// Is one of the images mirrored? No camera sees an opaque surface from both sides; mgca_filter/fit/mirror.py.
//
// A picture and its mirrored copy agree with a whole family of essential matrices, those of a camera that looks at the
// picture from behind, and so pass for a scene with a well-supported pose; a scene with depth of which one image was
// mirrored agrees with one. Triangles of matches tell: a mirror turns the orientation of nearly all of them.

#pragma once

#include "verdict.hpp"

namespace mgca::detail {

/// The verdict with the mirroring homography in the place of a pose, where that is what the matches tell; of a mirrored
/// scene with depth low support and no pose; else the verdict itself.
///
/// @param evidence what the model was fitted to. verdict: on that model. mask_threshold_px: Sampson distance below which
/// a match is kept, pixels.
Verdict judge_mirror(const PairInput& pair, const Evidence& evidence, Verdict verdict, double mask_threshold_px,
                     const Options& options);

/// Share of the triangles of matches that are seen from their other side in image 2.
double share_of_turned_triangles(const Correspondences& matches);

}  // namespace mgca::detail
