// Runs NUnit tests and writes a line of JSON for each: what NUnit 2.6 (Debian) and 3.5 (Unity) have in common.
// Known: TestFixture, SetUp, TearDown, Test, TestCase (ExpectedResult), TestCaseSource (static members), Category("Long"),
// Ignore, Explicit. Exit status 0 when all tests ran, whatever they found.
using System;
using System.Collections;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Reflection;
using System.Runtime.ExceptionServices;
using System.Text;
using NUnit.Framework;

static class Runner
{
    const string Long = "Long";
    static readonly object[] Nothing = new object[0];
    static TextWriter results;
    static string filter = "";
    static bool runsLong;

    static int Main(string[] arguments)
    {
        var assemblies = new List<string>();
        for (int i = 1; i < arguments.Length; i++)
        {
            if (arguments[i] == "--long") runsLong = true;
            else if (arguments[i] == "--filter") filter = arguments[++i];
            else assemblies.Add(arguments[i]);
        }
        using (results = new StreamWriter(arguments[0], false, new UTF8Encoding(false)))
            foreach (string path in assemblies)
                foreach (Type type in Assembly.LoadFrom(path).GetTypes().OrderBy(each => each.FullName, StringComparer.Ordinal))
                    if (type.IsDefined(typeof(TestFixtureAttribute), true) && !type.IsAbstract) RunFixture(type);
        return 0;
    }

    static void RunFixture(Type type)
    {
        foreach (MethodInfo method in type.GetMethods().OrderBy(each => each.Name, StringComparer.Ordinal))
            foreach (object[] values in ListCases(type, method))
            {
                var expected = values.Length > 0 ? values[values.Length - 1] as Expected : null;
                object[] given = expected == null ? values : values.Take(values.Length - 1).ToArray();
                string name = type.FullName + "." + method.Name;
                if (given.Length > 0) name += "(" + string.Join(", ", given.Select(Describe)) + ")";
                if (name.IndexOf(filter, StringComparison.Ordinal) < 0) continue;
                bool isLong = IsLong(type) || IsLong(method);
                if (method.IsDefined(typeof(ExplicitAttribute), true) || isLong && !runsLong) continue;
                RunTest(type, method, given, expected, name);
            }
    }

    static bool IsLong(MemberInfo member)
    {
        return member.GetCustomAttributes(typeof(CategoryAttribute), true).Any(each => ((CategoryAttribute)each).Name == Long);
    }

    sealed class Expected { public object Result; }

    static IEnumerable<object[]> ListCases(Type type, MethodInfo method)
    {
        if (method.IsDefined(typeof(TestAttribute), true) && method.GetParameters().Length == 0) yield return Nothing;
        foreach (TestCaseAttribute each in method.GetCustomAttributes(typeof(TestCaseAttribute), true))
        {
            object[] values = Convert(each.Arguments, method);
            yield return each.HasExpectedResult
                ? values.Append(new Expected { Result = each.ExpectedResult }).ToArray() : values;
        }
        foreach (TestCaseSourceAttribute each in method.GetCustomAttributes(typeof(TestCaseSourceAttribute), true))
            foreach (object item in ReadSource(each.SourceType ?? type, each.SourceName))
                yield return Convert(item as object[] ?? new[] { item }, method);
    }

    static IEnumerable ReadSource(Type type, string name)
    {
        const BindingFlags All = BindingFlags.Static | BindingFlags.Public | BindingFlags.NonPublic | BindingFlags.FlattenHierarchy;
        MemberInfo member = type.GetMember(name, All).FirstOrDefault();
        if (member is FieldInfo field) return (IEnumerable)field.GetValue(null);
        if (member is PropertyInfo property) return (IEnumerable)property.GetValue(null, null);
        if (member is MethodInfo method) return (IEnumerable)method.Invoke(null, Nothing);
        throw new InvalidOperationException(type + " has no static " + name);
    }

    // An attribute cannot hold a decimal or a long where its parameter is one: numbers are converted, as NUnit does.
    static object[] Convert(object[] values, MethodInfo method)
    {
        ParameterInfo[] parameters = method.GetParameters();
        return values.Select((value, i) => value is IConvertible && !parameters[i].ParameterType.IsInstanceOfType(value)
            && typeof(IConvertible).IsAssignableFrom(parameters[i].ParameterType) && !parameters[i].ParameterType.IsEnum
            ? System.Convert.ChangeType(value, parameters[i].ParameterType, CultureInfo.InvariantCulture) : value).ToArray();
    }

    static void RunTest(Type type, MethodInfo method, object[] values, Expected expected, string name)
    {
        string failure = null, skipped = null;
        var ignored = (IgnoreAttribute)type.GetCustomAttributes(typeof(IgnoreAttribute), true)
            .Concat(method.GetCustomAttributes(typeof(IgnoreAttribute), true)).FirstOrDefault();
        var watch = Stopwatch.StartNew();
        if (ignored != null) skipped = ignored.Reason ?? "ignored";
        else
        {
            Action cleaned = null;
            try
            {
                object fixture = Activator.CreateInstance(type);
                cleaned = () => { Call<TearDownAttribute>(fixture); (fixture as IDisposable)?.Dispose(); };
                Call<SetUpAttribute>(fixture);
                object result = Invoke(method, fixture, values);
                if (result is System.Threading.Tasks.Task) throw new NotSupportedException("tests that return a task are not known to Unity");
                if (expected != null) Assert.AreEqual(expected.Result, result);
            }
            catch (Exception error) { Judge(error, ref failure, ref skipped); }
            try { cleaned?.Invoke(); }
            catch (Exception error) { Judge(error, ref failure, ref skipped); }
        }
        var line = new StringBuilder("{\"name\": ").Append(Quote(name)).Append(", \"fixture\": ").Append(Quote(type.FullName));
        line.Append(", \"seconds\": ").Append(watch.Elapsed.TotalSeconds.ToString("0.####", CultureInfo.InvariantCulture));
        line.Append(", \"failure\": ").Append(Quote(failure ?? "")).Append(", \"skipped\": ").Append(Quote(failure == null ? skipped ?? "" : ""));
        results.WriteLine(line.Append('}'));
        results.Flush(); // also of a process that dies in the next test
    }

    static void Judge(Exception error, ref string failure, ref string skipped)
    {
        if (error is SuccessException) return;
        if (error is IgnoreException || error is InconclusiveException) skipped = error.Message;
        else failure = failure == null ? error.ToString() : failure + "\n" + error;
    }

    static void Call<T>(object fixture)
    {
        foreach (MethodInfo method in fixture.GetType().GetMethods())
            if (method.IsDefined(typeof(T), true)) Invoke(method, fixture, Nothing);
    }

    static object Invoke(MethodInfo method, object fixture, object[] values)
    {
        try { return method.Invoke(fixture, values); }
        catch (TargetInvocationException error)
        {
            ExceptionDispatchInfo.Capture(error.InnerException).Throw();
            return null;
        }
    }

    static string Describe(object value)
    {
        if (value is string text) return "\"" + text + "\"";
        return value is IFormattable number ? number.ToString(null, CultureInfo.InvariantCulture) : value?.ToString() ?? "null";
    }

    static string Quote(string text)
    {
        var quoted = new StringBuilder("\"");
        foreach (char unit in text)
        {
            if (unit == '"' || unit == '\\') quoted.Append('\\').Append(unit);
            else if (unit < ' ' || unit > '~') quoted.Append("\\u").Append(((int)unit).ToString("x4"));
            else quoted.Append(unit);
        }
        return quoted.Append('"').ToString();
    }
}
