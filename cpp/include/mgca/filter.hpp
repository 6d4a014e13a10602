// Tells right feature matches from wrong ones and estimates the two-view geometry.
//
//     const mgca::Filter filter(mgca::embedded_model());
//     const mgca::Result result = filter(keypoints1, keypoints2, knn_matches, K);
//     if (result.ok()) use(*result.R, *result.t);
//
// embedded_model() holds two networks: a quick one is asked first, a deeper one where that does not settle the pair. From
// files that is Model::from_file("mgca_small.onnx").with_first_look(Model::from_file("mgca_fast.onnx")). One file alone is
// possible: then pairs that need a network take longer (mgca_small), or are answered a little less accurately (mgca_fast).
//
// The only header of the library; it needs C++17 and OpenCV's core. Conventions: pixels follow OpenCV (the centre of the
// top-left pixel is (0, 0)), X2 = R X1 + t, x2^T E x1 = 0 on the normalised image planes, p2^T F p1 = 0 and p2 ~ H p1 in
// pixels. The library gives the answers of the Python package `mgca_filter` on the same model files.

#pragma once

#include <mgca/version.hpp>

#include <opencv2/core.hpp>

#include <cstddef>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#if defined(__GNUC__)
#define MGCA_API __attribute__((visibility("default")))
#else
#define MGCA_API
#endif

namespace mgca {

/// What the library throws, and nothing else: data never does, misuse always. The message names what is wrong.
class MGCA_API Error : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// An argument or option is out of its range, or does not fit the others.
class MGCA_API ArgumentError : public Error {
public:
    using Error::Error;
};

/// The model file is missing, damaged, or of another contract.
class MGCA_API ModelError : public Error {
public:
    using Error::Error;
};

/// The inference runtime cannot start, or failed, for lack of memory, say.
class MGCA_API RuntimeError : public Error {
public:
    using Error::Error;
};

/// Verdict on a pair of images; only `ok` and `planar` come with a pose that can be used as it is.
enum class Status {
    ok,                     ///< The geometry stands on firm ground.
    too_few_matches,        ///< Fewer than six distinct matches, without intrinsics than eight: nothing was tried.
    no_geometry,            ///< No model was found, or the inliers lie on a line.
    low_support,            ///< A model was found and is doubtful.
    unrelated,              ///< What was found is chance: the images do not show the same scene.
    planar,                 ///< A plane explains the inliers: H. With K the pose is kept.
    pure_rotation,          ///< A rotation explains the inliers: R and H, no t.
    suspicious_intrinsics,  ///< The matches contradict the focal length.
};

/// The word for a status, as the Python package writes it: "ok", "too_few_matches", ...
MGCA_API const char* to_string(Status status) noexcept;

/// Robust fit: several unlike estimators and the most likely of what they find; or one of them alone; or none, which
/// leaves scores and a mask by score.
enum class Method { automatic, prosac, magsac, ransac, none };

/// Automatic leaves the networks out where a run on the list alone explains it; full always runs them all.
enum class Effort { automatic, full };

/// Automatic: an essential matrix where intrinsics are given, else a fundamental matrix, and a homography beside or
/// instead of it where that explains the pair. Essential demands the intrinsics; fundamental does not let them constrain
/// the model; homography fits one and no more.
enum class Geometry { automatic, essential, fundamental, homography };

/// The values for words of the Python package: "auto", "prosac", "magsac", "ransac", "none"; "auto", "full"; "auto",
/// "essential", "fundamental", "homography". Another word throws ArgumentError.
MGCA_API Method to_method(const std::string& word);
MGCA_API Effort to_effort(const std::string& word);
MGCA_API Geometry to_geometry(const std::string& word);

/// Where the intrinsics of an answer come from.
enum class IntrinsicsSource { given, estimated, guessed };

/// The word for it: "given", "estimated" or "guessed".
MGCA_API const char* to_string(IntrinsicsSource source) noexcept;

/// Settings of the filter.
struct Options {
    double threshold = 1.0;                ///< Inlier threshold of the mask: Sampson distance, pixels.
    std::optional<double> keep_precision;  ///< Instead of a threshold: expected precision of the mask, in (0, 1).
    double confidence = 0.999;             ///< Of the robust fit, in (0, 1).
    Method method = Method::automatic;     ///< Robust fit.
    Effort effort = Effort::automatic;     ///< Whether easy pairs may go without the networks.
    Geometry geometry = Geometry::automatic;  ///< Model that is asked for.
    int max_iterations = 5000;             ///< Largest number of samples that one run of an estimator draws.
    int seed = 0;                          ///< Of every random choice, not negative; same seed, same answer.
};

/// Settings of the inference runtime.
struct RuntimeOptions {
    int threads = 1;  ///< Threads of one forward pass; 0 = as many as there are cores.
    /// Execution providers of ONNX Runtime, the preferred first ("CUDAExecutionProvider"); none = CPU. Must be empty where
    /// the library was built on cv::dnn.
    std::vector<std::string> providers;
    /// One that is missing or cannot start gives way to the CPU, which Model::notes tells; otherwise it is a RuntimeError.
    bool cpu_fallback = true;
    /// Options of a provider by its name, as ONNX Runtime names them.
    std::map<std::string, std::map<std::string, std::string>> provider_options;
};

/// One or two open model files, the deepest network last. Cheap to copy: copies share the sessions. Safe to use from
/// several threads.
class MGCA_API Model {
public:
    /// Open an ONNX file of mgca_filter. Throws ModelError, also where the SHA256SUMS beside it lists another file of this
    /// name, or RuntimeError.
    static Model from_file(const std::filesystem::path& file, const RuntimeOptions& options = {});

    /// The same from bytes, which need not outlive the call.
    static Model from_memory(const void* data, std::size_t size, const RuntimeOptions& options = {});

    /// A model that asks the network of another file, a quicker one, first, and this one where that does not settle the pair.
    /// Throws ArgumentError where either holds two already.
    Model with_first_look(const Model& quick) const;

    /// Name of the model, as its file says; of two "mgca_fast + mgca_small", in the order in which they are asked.
    const std::string& name() const noexcept;

    /// Version of the model, as its file says; of two likewise.
    const std::string& version() const noexcept;

    /// SHA-256 of the model file, hexadecimal; of two likewise.
    const std::string& sha256() const noexcept;

    /// Sentences on what turned out otherwise than asked for: another provider.
    const std::vector<std::string>& notes() const noexcept;

    /// Name and version of the inference runtime.
    static std::string runtime();

    struct State;

private:
    friend class Filter;
    friend MGCA_API Model embedded_model(const RuntimeOptions& options);
    explicit Model(std::shared_ptr<const State> state) : state_(std::move(state)) {}
    std::shared_ptr<const State> state_;
};

/// The library was built with models in it (MGCA_EMBED_MODEL).
MGCA_API bool has_embedded_model() noexcept;

/// Open the models that are within the library, the quick one as the first look; throws ModelError where it was built
/// without one, or RuntimeError.
MGCA_API Model embedded_model(const RuntimeOptions& options = {});

/// Keypoints of one image; converts from what OpenCV programs hold.
struct MGCA_API Keypoints {
    Keypoints() = default;
    Keypoints(const std::vector<cv::KeyPoint>& keypoints);  // NOLINT: implicit on purpose
    Keypoints(const std::vector<cv::Point2f>& pixels);      // NOLINT
    Keypoints(std::vector<cv::Point2d> pixels);             // NOLINT

    std::vector<cv::Point2d> points;  ///< Pixels; what is not finite is set aside.
    std::vector<float> sizes;         ///< Diameters in pixels, one for each point or none.
    std::vector<float> angles;        ///< Degrees, -1 = unknown, one for each point or none.
};

/// Putative matches; converts from what OpenCV programs hold.
struct MGCA_API Matches {
    Matches() = default;
    Matches(const std::vector<cv::DMatch>& matches);  // NOLINT: implicit on purpose
    /// Output of knnMatch: the first candidate of a row is the match, the second gives the ratio of distances. An empty
    /// row keeps its place and is never kept.
    Matches(const std::vector<std::vector<cv::DMatch>>& matches);  // NOLINT
    /// Keypoint i of image 1 matches keypoint i of image 2.
    static Matches same_rows(std::size_t count);

    std::vector<int> index1, index2;                 ///< Rows of the keypoints; -1 in both = no match.
    std::vector<double> distances;                   ///< Of the descriptors, NaN = unknown; one for each match or none.
    std::vector<double> second_distances;            ///< Of the second candidates; likewise.
};

/// Distortion of OpenCV's fisheye model (cv::fisheye).
struct Fisheye {
    double k1 = 0.0, k2 = 0.0, k3 = 0.0, k4 = 0.0;
};

/// Camera of one image. Everything may be unknown: without K the focal lengths are estimated from the matches, one or,
/// where they ask for it, two; where that fails F comes without E, R and t.
struct Camera {
    Camera() = default;
    Camera(const cv::Matx33d& intrinsics, std::vector<double> distortion_coefficients = {},  // NOLINT: implicit
           cv::Size2d image_size = {})
        : K(intrinsics), distortion(std::move(distortion_coefficients)), size(image_size) {}
    explicit Camera(cv::Size2d image_size) : size(image_size) {}

    std::optional<cv::Matx33d> K;    ///< [[fx, s, cx], [0, fy, cy], [0, 0, 1]], pixels.
    std::vector<double> distortion;  ///< OpenCV's coefficients (4, 5, 8, 12 or 14) of the pinhole model, or none.
    std::optional<Fisheye> fisheye;  ///< In place of them: the lens is a fisheye.
    cv::Size2d size;                 ///< Width and height in pixels, or zeros; helps the guess of missing intrinsics.
};

/// What a caller knows of each match beyond its position; every vector holds one value for each match, or none. Overrides
/// what keypoints and matches say, field by field.
struct Attributes {
    std::vector<float> ratio;         ///< Distance to nearest over distance to second nearest descriptor; NaN = unknown.
    std::vector<unsigned char> best;  ///< 1 = no other match reaches the same keypoint of image 2 at less distance.
    std::vector<float> size1, size2;    ///< Diameters of the keypoints, pixels.
    std::vector<float> angle1, angle2;  ///< Orientations, degrees, -1 = unknown.
};

/// Everything that a caller knows of one pair of images.
struct MatchPair {
    Keypoints keypoints1, keypoints2;
    Matches matches;
    Camera camera1, camera2;  ///< A second camera without K has that of the first.
    Attributes attributes;
    /// Pixels of the original per pixel of the image in which the keypoints were found, where they were found in a smaller
    /// copy; thresholds are then those of the copy.
    double resolution = 1.0;
};

/// Answer for M matches; vectors have one entry for each match, in the order of the input.
struct Result {
    std::vector<unsigned char> mask;  ///< 1 where the match agrees with the final model; all 0 without one.
    std::vector<float> scores;        ///< Calibrated probabilities that the matches are right.
    std::vector<float> logits;        ///< What the scores were calibrated from.
    Status status = Status::no_geometry;
    int num_inliers = 0;               ///< Number of ones in `mask`.
    std::optional<double> confidence;  ///< Probability that the pose is within 10 degrees; with K and a pose only.

    std::optional<cv::Matx33d> E;  ///< Essential matrix of unit Frobenius norm, of undistorted points.
    std::optional<cv::Matx33d> F;  ///< Fundamental matrix of unit Frobenius norm, likewise.
    std::optional<cv::Matx33d> R;  ///< Rotation.
    std::optional<cv::Vec3d> t;    ///< Translation of unit length.
    std::optional<cv::Matx33d> H;  ///< Homography that explains the pair, or was asked for; H(2, 2) = 1.

    IntrinsicsSource intrinsics = IntrinsicsSource::given;
    /// Estimated focal lengths of both images, pixels, equal unless the matches ask for two.
    std::optional<cv::Vec2d> focal_px;
    std::optional<cv::Vec2d> focal_sigma;       ///< Their relative standard deviations.
    std::optional<double> focal_sigma_deg;      ///< Standard deviation of the pose that comes of that alone.
    std::optional<double> fitted_confidence;    ///< What `confidence` would be if the focal lengths were known.
    /// Estimated focal lengths alone make the pose doubtful: low_support, with matches that are right all the same.
    bool focal_doubt = false;
    std::vector<std::string> assumptions;       ///< Sentences on what was assumed.
    int num_accepted = 0;                       ///< Matches whose logit is above the model's decision threshold.
    std::optional<cv::Matx33d> network_essential;  ///< Essential matrix as the last of them gave it.
    std::optional<cv::Matx33d> fitted_essential;   ///< As the robust fit left it, before the verdict.
    int num_network_matches = 0;                ///< Matches that entered the first network; 0 where none was needed.
    std::vector<std::string> networks;          ///< Names of the networks that were asked, in that order; perhaps none.
    std::string origin;                         ///< Source that proposed the model: "list", "network", "accepted", ...
    std::string ended;                          ///< "before the network", "first sources" or "all sources".
    std::optional<int> support;                 ///< Accepted matches that agree with the model.
    std::optional<double> log10_false_alarms;   ///< How many models chance would support as well.
    std::optional<double> translation_sigma_deg;  ///< Standard deviation of the direction of translation.
    std::optional<double> focal_factor;         ///< The matches ask for focal lengths this many times those given.
    /// One of the images was flipped: there is no pose, and H mirrors where the pair is planar.
    bool mirrored = false;

    /// The pose of camera 2 relative to camera 1, X2 = T X1 in homogeneous coordinates; nothing without R or t. Two views
    /// do not tell the baseline, the distance of the cameras: it is 1 unless the caller knows better.
    std::optional<cv::Matx44d> relative_pose(double baseline = 1.0) const {
        if (!R || !t) {
            return std::nullopt;
        }
        cv::Matx44d T = cv::Matx44d::eye();
        for (int row = 0; row < 3; ++row) {
            for (int column = 0; column < 3; ++column) {
                T(row, column) = (*R)(row, column);
            }
            T(row, 3) = baseline * (*t)[row];
        }
        return T;
    }

    /// The geometry may be used as it is.
    bool ok() const noexcept { return status == Status::ok || status == Status::planar; }

    /// The kept matches may be used, whatever the pose is worth: a model explains the pair.
    bool verified() const noexcept { return ok() || status == Status::pure_rotation || focal_doubt; }
};

/// The filter. Safe to use from several threads; cheap to copy.
class MGCA_API Filter {
public:
    /// Throws ArgumentError for an option out of its range.
    explicit Filter(Model model, const Options& options = {});

    /// Filter the matches of one pair.
    ///
    /// Throws ArgumentError for an index out of range, vectors of different length or a matrix that is no K, and
    /// RuntimeError where the inference runtime fails. Data never raises: where there is no geometry, the status says why.
    Result operator()(const MatchPair& pair) const;

    /// The same for two cameras; both may be unknown.
    Result operator()(const Keypoints& keypoints1, const Keypoints& keypoints2, const Matches& matches,
                      const Camera& camera1, const Camera& camera2) const;

    /// The same for one camera that took both images, or an unknown one.
    Result operator()(const Keypoints& keypoints1, const Keypoints& keypoints2, const Matches& matches,
                      const Camera& camera = {}) const;

    const Options& options() const noexcept { return options_; }

private:
    Model model_;
    Options options_;
};

}  // namespace mgca
