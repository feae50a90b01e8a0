// Writes a recorded log in MRPT's own form, for the programs of mrpt-apps in bench/slam_peers.py.
//
//   mrpt_rawlog SCANS OBSERVATIONS FRAMES
//
// SCANS: text; the laser's mount (x y yaw) and greatest range, then per scan its stamp, the odometry pose (x y yaw),
// first bearing, step between beams, number of beams, and that many ranges (-1: none).
// OBSERVATIONS: odometry and scan in turn, as icp-slam reads them. FRAMES: the motion since the last scan and the scan,
// as rbpf-slam needs them (2.5.8 crashes on the other form). Motion models are MRPT's defaults.
// carmen2rawlog is not used: in 2.5.8 it gives every scan the same stamp.

#include <mrpt/core/Clock.h>
#include <mrpt/io/CFileGZOutputStream.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CObservationOdometry.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/serialization/CArchive.h>

#include <fstream>

int main(int argc, char** argv)
{
	if (argc != 4) return 2;
	std::ifstream file(argv[1]);
	mrpt::io::CFileGZOutputStream observations_file(argv[2]), frames_file(argv[3]);
	auto observations = mrpt::serialization::archiveFrom(observations_file);
	auto frames = mrpt::serialization::archiveFrom(frames_file);

	double mount_x, mount_y, mount_yaw, range_max;
	file >> mount_x >> mount_y >> mount_yaw >> range_max;

	mrpt::poses::CPose2D last;
	bool first_scan = true;
	double stamp, x, y, yaw, first, step;
	size_t beams;
	while (file >> stamp >> x >> y >> yaw >> first >> step >> beams)
	{
		const double aperture = step * double(beams - 1);
		auto scan = mrpt::obs::CObservation2DRangeScan::Create();
		scan->sensorLabel = "LASER";
		scan->timestamp = mrpt::Clock::fromDouble(stamp);
		scan->maxRange = float(range_max);
		scan->rightToLeft = true;
		scan->aperture = float(aperture);  // spread evenly about the sensor's axis, which is turned to fit
		scan->sensorPose = mrpt::poses::CPose3D(mount_x, mount_y, 0.0, mount_yaw + first + aperture / 2.0, 0.0, 0.0);
		scan->resizeScan(beams);
		for (size_t k = 0; k < beams; ++k)
		{
			float range = 0.0f;
			file >> range;
			scan->setScanRange(k, range > 0.0f ? range : float(range_max));
			scan->setScanRangeValidity(k, range > 0.0f);
		}

		const mrpt::poses::CPose2D now(x, y, yaw);
		auto odometry = mrpt::obs::CObservationOdometry::Create();
		odometry->sensorLabel = "ODOMETRY";
		odometry->timestamp = scan->timestamp;
		odometry->odometry = now;
		observations << *odometry << *scan;

		mrpt::obs::CActionRobotMovement2D motion;
		const mrpt::obs::CActionRobotMovement2D::TMotionModelOptions model;
		motion.computeFromOdometry(first_scan ? mrpt::poses::CPose2D() : now - last, model);
		motion.timestamp = scan->timestamp;
		last = now;
		first_scan = false;
		mrpt::obs::CActionCollection actions;
		actions.insert(motion);
		mrpt::obs::CSensoryFrame frame;
		frame.insert(scan);
		frames << actions << frame;
	}
	return first_scan ? 1 : 0;
}
