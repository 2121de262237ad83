using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    /// <summary>Hands with one gesture take, move and release robots.</summary>
    [TestFixture]
    public class AirTapTests
    {
        [Test]
        public void TapTakesARobotAndHeldElsewhereMovesIt()
        {
            Wearer wearer = new Wearer();
            AirTap taps = new AirTap();
            Run(wearer, taps, 0, 0, 2);
            Run(wearer, taps, 1, 0, 2);
            Assert.AreEqual(new[] { "right" }, ((Acquire)wearer.Session.Requests[0]).Robots);
            wearer.Session.Give("right", "p1");
            wearer.Input.TakeReply(1, new Reply { Ok = true }, wearer.Input.Reading.CaptureNs);
            Run(wearer, taps, 1, 0, 10);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch, "the tap that took it moves nothing");
            Run(wearer, taps, 0, 0, 2);
            Run(wearer, taps, 1, 0, 12);
            Assert.IsTrue(wearer.Session.Find(Device.ControllerRight).Clutch, "also while the hand points at its own robot");
            Run(wearer, taps, 0, 0, 2);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
            Assert.AreEqual(1, wearer.Session.Requests.Count);
        }

        [Test]
        public void GraspIsTheGripperWhileATapMoves()
        {
            Wearer wearer = new Wearer();
            AirTap taps = new AirTap();
            wearer.Take(Side.Right, "right");
            wearer.Input.Take(new Feedback { Robot = "right" }, 0);
            Run(wearer, taps, 0, 0, 2);
            Run(wearer, taps, 1, 1, 12);
            Assert.AreEqual(1, wearer.Session.Find(Device.ControllerRight).Gripper);
        }

        [Test]
        public void TapAtAnotherRobotTakesThatOne()
        {
            Wearer wearer = new Wearer();
            AirTap taps = new AirTap();
            wearer.Take(Side.Right, "right");
            int before = wearer.Session.Requests.Count;
            wearer[Side.Right].Ray = new AimRay(new Double3(0.2, 0.3, 1.1), new Double3(1, 0, 0)); // at the left one
            Run(wearer, taps, 0, 0, 2);
            Run(wearer, taps, 1, 0, 2);
            Assert.AreEqual(new[] { "left" }, ((Acquire)wearer.Session.Requests[before]).Robots);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
        }

        [Test]
        public void GraspHeldAtOnesRobotReleasesIt()
        {
            Wearer wearer = new Wearer();
            AirTap taps = new AirTap();
            wearer.Take(Side.Right, "right");
            int before = wearer.Session.Requests.Count;
            Run(wearer, taps, 0, 0, 2);
            Run(wearer, taps, 0, 1, 70);
            Assert.IsInstanceOf<Release>(wearer.Session.Requests[before]);
        }

        /// <summary>Run frames in which the right hand taps and grasps so much.</summary>
        private static void Run(Wearer wearer, AirTap taps, double tap, double grasp, int frames)
        {
            for (int i = 0; i < frames; i++)
            {
                wearer[Side.Right].Trigger = tap;
                wearer[Side.Right].Squeeze = grasp;
                taps.Apply(wearer.Input);
                wearer.Run();
            }
        }
    }
}
