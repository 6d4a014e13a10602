/* The filter for C, and for every language that can call C.
 *
 *     mgca_model *model = NULL;
 *     mgca_filter *filter = NULL;
 *     mgca_result *result = NULL;
 *     if (mgca_model_open(NULL, 1, NULL, &model) || mgca_filter_create(model, &filter) ||
 *         mgca_filter_points(filter, points1, points2, NULL, count, K, NULL, &result)) {
 *         fprintf(stderr, "%s\n", mgca_last_error());
 *     } else if (mgca_result_ok(result)) {
 *         use(mgca_result_matrix(result, "R"), mgca_result_translation(result), mgca_result_mask(result));
 *     }
 *     mgca_result_free(result);
 *     mgca_filter_free(filter);
 *     mgca_model_close(model);
 *
 * Handles are opaque, arrays plain, matrices row by row; no exception crosses the border. A call that can fail returns
 * MGCA_DONE or the kind of its error, and mgca_last_error() says in words what is wrong. Conventions, options and answers
 * are those of mgca/filter.hpp. What a call is given it copies; what it returns a pointer to lives as long as the handle.
 * A model may be closed while filters use it. One filter may run in several threads at once while nobody sets its options.
 */

#ifndef MGCA_MGCA_H
#define MGCA_MGCA_H

#include <stddef.h>
#include <stdint.h>

#if defined(__GNUC__)
#define MGCA_C_API __attribute__((visibility("default")))
#else
#define MGCA_C_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Kinds of errors. Data is never an error: where there is no geometry, the status of the result says why. */
enum {
    MGCA_DONE = 0,
    MGCA_ARGUMENT_ERROR = 1, /* an argument or option is out of its range, or does not fit the others */
    MGCA_MODEL_ERROR = 2,    /* the model file is missing, damaged, or of another contract */
    MGCA_RUNTIME_ERROR = 3,  /* the inference runtime cannot start, or failed */
    MGCA_INTERNAL_ERROR = 4  /* no memory, or a fault of the library */
};

/* Statuses of a result; only those of MGCA_OK and MGCA_PLANAR may be used as they are. */
enum {
    MGCA_OK = 0,
    MGCA_TOO_FEW_MATCHES = 1,
    MGCA_NO_GEOMETRY = 2,
    MGCA_LOW_SUPPORT = 3,
    MGCA_UNRELATED = 4,
    MGCA_PLANAR = 5,
    MGCA_PURE_ROTATION = 6,
    MGCA_SUSPICIOUS_INTRINSICS = 7
};

typedef struct mgca_model mgca_model;
typedef struct mgca_filter mgca_filter;
typedef struct mgca_pair mgca_pair;
typedef struct mgca_result mgca_result;

/* What was wrong in the last call of this thread that failed; never NULL. */
MGCA_C_API const char *mgca_last_error(void);

/* Version of the library, "0.1.0". */
MGCA_C_API const char *mgca_version(void);

/* The word for a status, "ok", "too_few_matches", ..., or "" for a number that is none. */
MGCA_C_API const char *mgca_status_word(int status);

/* Models ----------------------------------------------------------------------------------------------------------- */

/* Open an ONNX file of mgca_filter; NULL = the models within the library, where it was built with them: a quick network,
 * which is asked first, and a deeper one for the pairs that it does not settle.
 * threads: of one forward pass, 0 = as many as there are cores. providers: execution providers of ONNX Runtime, the
 * preferred first, separated by commas; NULL = CPU. One that is missing or cannot start gives way to the CPU, with a note. */
MGCA_C_API int mgca_model_open(const char *file, int threads, const char *providers, mgca_model **model);

/* The same from the bytes of a file. */
MGCA_C_API int mgca_model_open_memory(const void *data, size_t size, int threads, const char *providers,
                                      mgca_model **model);

/* A model that asks the network of another one, a quicker one, first, and its own where that does not settle the pair.
 * Either holds one file; both may be closed. One file alone is possible: then pairs that need a network take longer
 * (mgca_small), or are answered a little less accurately (mgca_fast). */
MGCA_C_API int mgca_model_with_first_look(const mgca_model *model, const mgca_model *first_look, mgca_model **both);

/* What the file says of itself, and its digest; of two "mgca_fast + mgca_small", in the order in which they are asked. */
MGCA_C_API const char *mgca_model_name(const mgca_model *model);
MGCA_C_API const char *mgca_model_version(const mgca_model *model);
MGCA_C_API const char *mgca_model_sha256(const mgca_model *model);

/* A sentence on what turned out otherwise than asked for, from index 0 on; NULL behind the last. */
MGCA_C_API const char *mgca_model_note(const mgca_model *model, size_t index);

MGCA_C_API void mgca_model_close(mgca_model *model);

/* Filters ---------------------------------------------------------------------------------------------------------- */

MGCA_C_API int mgca_filter_create(const mgca_model *model, mgca_filter **filter);

/* Set "threshold", "keep_precision", "confidence", "max_iterations" or "seed". */
MGCA_C_API int mgca_filter_set_number(mgca_filter *filter, const char *option, double value);

/* Set "method", "effort" or "geometry", to a word of the Python package ("auto", "magsac", ...). */
MGCA_C_API int mgca_filter_set_word(mgca_filter *filter, const char *option, const char *value);

/* Filter matches that are two lists of pixels: x and y of count points in each image, row i of one matches row i of the
 * other. ratio: distances to the nearest over those to the second nearest descriptors, or NULL. K1, K2: nine numbers each,
 * or NULL; K1 alone = both images share it. */
MGCA_C_API int mgca_filter_points(const mgca_filter *filter, const double *points1, const double *points2,
                                  const float *ratio, size_t count, const double *K1, const double *K2,
                                  mgca_result **result);

/* Filter a pair of which more is known. */
MGCA_C_API int mgca_filter_run(const mgca_filter *filter, const mgca_pair *pair, mgca_result **result);

MGCA_C_API void mgca_filter_free(mgca_filter *filter);

/* Pairs ------------------------------------------------------------------------------------------------------------ */

MGCA_C_API int mgca_pair_create(mgca_pair **pair);

/* Keypoints of image 1 or 2: x and y of each, pixels; diameters in pixels and angles in degrees (-1 = unknown), or NULL. */
MGCA_C_API int mgca_pair_set_keypoints(mgca_pair *pair, int image, const double *points, const float *sizes,
                                       const float *angles, size_t count);

/* Matches: rows of both keypoints of each, -1 in both = no match; NULL = row i of one list matches row i of the other.
 * distances: of their descriptors, second_distances: of the second nearest, NaN = unknown; or NULL. */
MGCA_C_API int mgca_pair_set_matches(mgca_pair *pair, const int32_t *indices, const double *distances,
                                     const double *second_distances, size_t count);

/* Camera of image 1 or 2: nine numbers of K or NULL; coefficients of OpenCV's distortion (4, 5, 8, 12 or 14) or NULL;
 * width and height in pixels, or zeros. A second camera without K has that of the first. */
MGCA_C_API int mgca_pair_set_camera(mgca_pair *pair, int image, const double *K, const double *distortion,
                                    size_t num_distortion, double width, double height);

/* The lens of image 1 or 2 is a fisheye of OpenCV's model with these four coefficients. */
MGCA_C_API int mgca_pair_set_fisheye(mgca_pair *pair, int image, const double *k);

/* What is known of each match beyond its position: "ratio", "size1", "size2", "angle1", "angle2", or "best" (1 = no other
 * match reaches the same keypoint of image 2 at less distance, else 0). */
MGCA_C_API int mgca_pair_set_attribute(mgca_pair *pair, const char *name, const float *values, size_t count);

/* Pixels of the original per pixel of the smaller copy in which the keypoints were found. */
MGCA_C_API int mgca_pair_set_resolution(mgca_pair *pair, double resolution);

MGCA_C_API void mgca_pair_free(mgca_pair *pair);

/* Results ---------------------------------------------------------------------------------------------------------- */

MGCA_C_API int mgca_result_status(const mgca_result *result);

/* 1 where the geometry may be used as it is, else 0. */
MGCA_C_API int mgca_result_ok(const mgca_result *result);

/* 1 where the kept matches may be used, whatever the pose is worth, else 0. */
MGCA_C_API int mgca_result_verified(const mgca_result *result);

/* Number of matches, which is that of the entries of mask, scores and logits. */
MGCA_C_API size_t mgca_result_size(const mgca_result *result);

/* 1 where the match agrees with the final model, else 0. */
MGCA_C_API const unsigned char *mgca_result_mask(const mgca_result *result);

/* Calibrated probabilities that the matches are right, and what they were calibrated from. */
MGCA_C_API const float *mgca_result_scores(const mgca_result *result);
MGCA_C_API const float *mgca_result_logits(const mgca_result *result);

/* Nine numbers of "E", "F", "R" or "H"; NULL where there is none. */
MGCA_C_API const double *mgca_result_matrix(const mgca_result *result, const char *name);

/* Three numbers of unit length; NULL where there is none. */
MGCA_C_API const double *mgca_result_translation(const mgca_result *result);

/* "num_inliers", "num_accepted", "confidence", "num_network_matches", "support", "log10_false_alarms",
 * "translation_sigma_deg", "focal_px1", "focal_px2" (estimated focal lengths of both images), "focal_sigma1",
 * "focal_sigma2" (their relative standard deviations), "focal_sigma_deg" (of the pose, on their account),
 * "fitted_confidence" (as if they were known) or "focal_factor", NaN where there is none; "mirrored", 1 where one of the
 * images was flipped, and "focal_doubt", 1 where the focal lengths alone make the pose doubtful, else 0. */
MGCA_C_API double mgca_result_number(const mgca_result *result, const char *name);

/* "intrinsics" ("given", "estimated" or "guessed"), "origin" or "ended"; NULL for another name. */
MGCA_C_API const char *mgca_result_word(const mgca_result *result, const char *name);

/* Name of a network that was asked, from index 0 on, in that order; NULL behind the last. */
MGCA_C_API const char *mgca_result_network(const mgca_result *result, size_t index);

/* A sentence on what was assumed, from index 0 on; NULL behind the last. */
MGCA_C_API const char *mgca_result_assumption(const mgca_result *result, size_t index);

MGCA_C_API void mgca_result_free(mgca_result *result);

#ifdef __cplusplus
}
#endif

#endif
