// Heat of the device on stand-ins of Java.
using System;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using UnityEngine;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class ThermalTests
    {
        private const string Method = "getCurrentThermalStatus";

        [SetUp]
        public void Begin()
        {
            Engine.Reset();
            JavaCalls.All.Clear();
            JavaCalls.Answers.Clear();
            Application.Platform = RuntimePlatform.Android;
        }

        [TearDown]
        public void End()
        {
            JavaCalls.Answers.Clear();
            Application.Platform = RuntimePlatform.LinuxPlayer;
        }

        [Test]
        public void HeatIsWhatTheSystemSays()
        {
            using (DeviceCondition condition = new DeviceCondition())
            {
                foreach ((int status, string heat) in new[] { (0, ThermalState.Nominal), (1, ThermalState.Warm), (2, ThermalState.Warm), (3, ThermalState.Hot), (6, ThermalState.Hot), (7, ""), (-1, "") })
                {
                    JavaCalls.Answers[Method] = status;
                    Assert.AreEqual(heat, condition.Read().Thermal, status.ToString());
                }
                Assert.AreEqual(1, JavaCalls.All.FindAll(one => one == "getSystemService").Count, "the service is found once");
                condition.Thermal = () => ThermalState.Warm;
                Assert.AreEqual(ThermalState.Warm, condition.Read().Thermal, "the application knows better");
            }
        }

        [Test]
        public void ASystemWithoutItIsAskedOnce()
        {
            JavaCalls.Answers[Method] = new InvalidOperationException("no such method");
            using (AndroidThermal thermal = new AndroidThermal())
            {
                Assert.AreEqual("", thermal.Read());
                Assert.AreEqual("", thermal.Read());
            }
            Assert.AreEqual(1, JavaCalls.All.FindAll(one => one == Method).Count);
            Application.Platform = RuntimePlatform.LinuxPlayer;
            JavaCalls.All.Clear();
            using (AndroidThermal thermal = new AndroidThermal()) Assert.AreEqual("", thermal.Read());
            Assert.IsEmpty(JavaCalls.All);
        }
    }
}
