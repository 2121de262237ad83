// Compares values with JSON of golden files, and reads MessagePack as such values without the classes of messages.
using System;
using System.Collections.Generic;
using System.Globalization;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    internal static class JsonCheck
    {
        /// <summary>Fail unless `actual` (null, bool, number, string, list, dictionary) is what `expected` says.</summary>
        public static void AreEqual(Json expected, object actual, string where)
        {
            switch (expected.Value)
            {
                case List<Json> items:
                    List<object> list = actual as List<object> ?? throw new AssertionException(where + ": no list");
                    Assert.AreEqual(items.Count, list.Count, where + ": length");
                    for (int i = 0; i < items.Count; i++) AreEqual(items[i], list[i], where + "[" + i + "]");
                    break;
                case List<KeyValuePair<string, Json>> fields:
                    Dictionary<string, object> map = actual as Dictionary<string, object> ?? throw new AssertionException(where + ": no map");
                    Assert.AreEqual(fields.Count, map.Count, where + ": fields");
                    foreach (KeyValuePair<string, Json> field in fields)
                    {
                        Assert.IsTrue(map.ContainsKey(field.Key), where + "." + field.Key);
                        AreEqual(field.Value, map[field.Key], where + "." + field.Key);
                    }
                    break;
                case double number:
                    Assert.AreEqual(number, Convert.ToDouble(actual, CultureInfo.InvariantCulture), 1e-9 * Math.Max(1.0, Math.Abs(number)), where);
                    break;
                case long number:
                    Assert.AreEqual((double)number, Convert.ToDouble(actual, CultureInfo.InvariantCulture), where);
                    break;
                default:
                    Assert.AreEqual(expected.Value, actual, where);
                    break;
            }
        }

        /// <summary>Return the value of a message as golden files write it: bytes in base64, floats that are not finite as null.</summary>
        public static object FromWire(WireValue value)
        {
            byte[] bytes = value.Encode();
            int at = 0;
            return ReadValue(bytes, ref at);
        }

        private static object ReadValue(byte[] bytes, ref int at)
        {
            byte code = bytes[at++];
            if (code < 0x80) return (long)code;
            if (code >= 0xe0) return (long)(sbyte)code;
            if (code < 0x90) return ReadMap(bytes, ref at, code & 15);
            if (code < 0xa0) return ReadList(bytes, ref at, code & 15);
            if (code < 0xc0) return ReadText(bytes, ref at, code & 31);
            switch (code)
            {
                case 0xc0: return null;
                case 0xc2: return false;
                case 0xc3: return true;
                case 0xc4: return ReadBytes(bytes, ref at, (int)Big(bytes, ref at, 1));
                case 0xc5: return ReadBytes(bytes, ref at, (int)Big(bytes, ref at, 2));
                case 0xcb:
                    double number = BitConverter.Int64BitsToDouble((long)Big(bytes, ref at, 8));
                    return double.IsNaN(number) || double.IsInfinity(number) ? null : (object)number;
                case 0xcc: return (long)Big(bytes, ref at, 1);
                case 0xcd: return (long)Big(bytes, ref at, 2);
                case 0xce: return (long)Big(bytes, ref at, 4);
                case 0xcf: return (long)Big(bytes, ref at, 8);
                case 0xd0: return (long)(sbyte)Big(bytes, ref at, 1);
                case 0xd1: return (long)(short)Big(bytes, ref at, 2);
                case 0xd2: return (long)(int)Big(bytes, ref at, 4);
                case 0xd3: return (long)Big(bytes, ref at, 8);
                case 0xd9: return ReadText(bytes, ref at, (int)Big(bytes, ref at, 1));
                case 0xda: return ReadText(bytes, ref at, (int)Big(bytes, ref at, 2));
                case 0xdc: return ReadList(bytes, ref at, (int)Big(bytes, ref at, 2));
                case 0xde: return ReadMap(bytes, ref at, (int)Big(bytes, ref at, 2));
                default: throw new ArgumentException("MessagePack type " + code);
            }
        }

        private static ulong Big(byte[] bytes, ref int at, int count)
        {
            ulong value = 0;
            for (int i = 0; i < count; i++) value = (value << 8) | bytes[at++];
            return value;
        }

        private static string ReadText(byte[] bytes, ref int at, int count)
        {
            at += count;
            return System.Text.Encoding.UTF8.GetString(bytes, at - count, count);
        }

        private static string ReadBytes(byte[] bytes, ref int at, int count)
        {
            at += count;
            return Convert.ToBase64String(bytes, at - count, count);
        }

        private static List<object> ReadList(byte[] bytes, ref int at, int count)
        {
            List<object> list = new List<object>();
            for (; count > 0; count--) list.Add(ReadValue(bytes, ref at));
            return list;
        }

        private static Dictionary<string, object> ReadMap(byte[] bytes, ref int at, int count)
        {
            Dictionary<string, object> map = new Dictionary<string, object>();
            for (; count > 0; count--)
            {
                string key = (string)ReadValue(bytes, ref at);
                map[key] = ReadValue(bytes, ref at);
            }
            return map;
        }
    }
}
