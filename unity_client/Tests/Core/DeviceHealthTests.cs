using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class DeviceHealthTests
    {
        [Test]
        public void ReportsSayFramesDroppedSinceTheOneBefore()
        {
            HealthMeter meter = new HealthMeter();
            Assert.AreEqual(-1, Fill(meter).Battery, "not known");
            Assert.AreEqual(0, Fill(meter).DroppedFrames);
            meter.Newest = new DeviceHealth { Battery = 0.5, IsCharging = true, Thermal = ThermalState.Hot, DroppedFrames = 100 };
            ClientReport report = Fill(meter);
            Assert.AreEqual(0.5, report.Battery);
            Assert.IsTrue(report.Charging);
            Assert.AreEqual(ThermalState.Hot, report.Thermal);
            Assert.AreEqual(0, report.DroppedFrames, "of before");
            meter.Newest = new DeviceHealth { Battery = double.NaN, DroppedFrames = 130 };
            report = Fill(meter);
            Assert.AreEqual(-1, report.Battery);
            Assert.AreEqual("", report.Thermal);
            Assert.AreEqual(30, report.DroppedFrames);
            meter.Newest = new DeviceHealth { DroppedFrames = 5 };
            Assert.AreEqual(0, Fill(meter).DroppedFrames, "begun anew");
        }

        private static ClientReport Fill(HealthMeter meter)
        {
            ClientReport report = new ClientReport();
            meter.Fill(report);
            return report;
        }
    }
}
